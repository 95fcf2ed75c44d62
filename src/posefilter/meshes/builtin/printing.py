"""Draw labels: text, barcodes, tables and shapes on a canvas measured in millimeters."""

import cv2
import numpy as np

Color = tuple[int, int, int]  # RGB
Box = tuple[float, float, float, float]  # x0, y0, x1, y1 [mm], y down

BLACK, WHITE, CREAM, RED = (20, 20, 22), (250, 250, 246), (246, 234, 202), (196, 24, 34)
NAVY = (18, 34, 92)
BLUE = (20, 84, 176)
SKY = (120, 186, 226)
GREEN = (22, 118, 62)
LIME = (148, 190, 40)
YELLOW = (250, 206, 34)
ORANGE = (238, 128, 28)
BROWN = (110, 66, 34)
KRAFT = (176, 138, 96)
GREY = (150, 152, 156)
_FONT = cv2.FONT_HERSHEY_DUPLEX


class Canvas:
    """An image with coordinates in millimeters."""

    px = 3.0  # a millimeter

    def __init__(self, width_mm: float, height_mm: float, color: Color) -> None:
        shape = (max(1, round(height_mm * self.px)), max(1, round(width_mm * self.px)), 3)
        self.image = np.full(shape, color, dtype=np.uint8)

    def _at(self, x_mm: float, y_mm: float) -> tuple[int, int]:
        return round(x_mm * self.px), round(y_mm * self.px)

    def rect(self, box: Box, color: Color, line_mm: float = 0) -> "Canvas":
        """Fill a rectangle, or draw its frame."""
        (x0, y0), (x1, y1) = self._at(*box[:2]), self._at(*box[2:])
        width = max(1, round(line_mm * self.px)) if line_mm else -1
        cv2.rectangle(self.image, (x0, y0), (x1 - 1, y1 - 1), color, width, cv2.LINE_AA)
        return self

    def ellipse(
        self,
        x: float,
        y: float,
        rx: float,
        ry: float,
        color: Color,
        turn_deg: float = 0,
        line_mm: float = 0,
    ) -> "Canvas":
        """Fill an ellipse, or draw its outline."""
        width = max(1, round(line_mm * self.px)) if line_mm else -1
        center, axes = self._at(x, y), self._at(rx, ry)
        cv2.ellipse(self.image, center, axes, turn_deg, 0, 360, color, width, cv2.LINE_AA)
        return self

    def polygon(self, points_mm: list[tuple[float, float]], color: Color) -> "Canvas":
        """Fill a polygon."""
        points = np.round(np.array(points_mm) * self.px).astype(np.int32)
        cv2.fillPoly(self.image, [points], color, cv2.LINE_AA)
        return self

    def fade(self, box: Box, top: Color, bottom: Color) -> "Canvas":
        """Fill a rectangle with a vertical gradient."""
        (x0, y0), (x1, y1) = self._at(*box[:2]), self._at(*box[2:])
        area = self.image[y0:y1, x0:x1]
        t = np.linspace(0, 1, area.shape[0])[:, None, None]
        area[:] = np.round((1 - t) * np.array(top) + t * np.array(bottom)).astype(np.uint8)
        return self

    def text(
        self, words: str, box: Box, color: Color, weight: float = 0.1, turned: bool = False
    ) -> "Canvas":
        """Print words, centered and as large as the box allows.

        Args:
            words: The text.
            box: Where [mm].
            color: RGB.
            weight: Width of the stroke over the height of the letters.
            turned: Print from bottom to top.
        """
        (x0, y0), (x1, y1) = self._at(*box[:2]), self._at(*box[2:])
        room = (y1 - y0, x1 - x0) if turned else (x1 - x0, y1 - y0)
        (base_w, base_h), _ = cv2.getTextSize(words, _FONT, 4.0, 1)
        size = min(room[0] * 0.96 / base_w, room[1] * 0.8 / base_h)
        height = base_h * size
        stroke = max(1, round(height * weight))
        patch = np.zeros((max(1, room[1]), max(1, room[0])), dtype=np.uint8)
        at = (round((room[0] - base_w * size) / 2), round((room[1] + height) / 2))
        cv2.putText(patch, words, at, _FONT, 4.0 * size, 255, stroke, cv2.LINE_AA)
        if turned:
            patch = np.ascontiguousarray(np.rot90(patch))
        area = self.image[y0 : y0 + patch.shape[0], x0 : x0 + patch.shape[1]]
        alpha = patch[: area.shape[0], : area.shape[1], None] / 255
        area[:] = np.round(area * (1 - alpha) + np.array(color) * alpha).astype(np.uint8)
        return self

    def lines(self, box: Box, color: Color, pitch_mm: float = 3.2, seed: int = 0) -> "Canvas":
        """Print rows of strokes that look like small text."""
        rng = np.random.default_rng(seed)
        y = box[1] + pitch_mm / 2
        while y < box[3]:
            x = box[0]
            end = box[2] - rng.uniform(0, 0.3) * (box[2] - box[0])
            while x < end - 1:
                word = min(rng.uniform(2, 8), end - x)
                self.rect((x, y - pitch_mm * 0.2, x + word, y + pitch_mm * 0.2), color)
                x += word + 1.3
            y += pitch_mm
        return self

    def barcode(self, box: Box, seed: int) -> "Canvas":
        """Print a barcode on white."""
        rng = np.random.default_rng(seed)
        self.rect(box, WHITE)
        x = box[0] + 1.5
        while x < box[2] - 2:
            bar = float(rng.choice([0.4, 0.8, 1.2]))
            self.rect((x, box[1] + 1.2, x + bar, box[3] - 1.2), BLACK)
            x += bar + float(rng.choice([0.5, 0.9]))
        return self

    def nutrition(self, box: Box, seed: int = 0) -> "Canvas":
        """Print a table of nutrition facts."""
        x0, y0, x1, y1 = box
        width, height = x1 - x0, y1 - y0
        self.rect(box, WHITE).rect(box, BLACK, 0.6)
        self.text("NUTRITION", (x0 + 1.5, y0 + 1, x1 - 1.5, y0 + 0.13 * height), BLACK, 0.14)
        self.rect((x0 + 1.5, y0 + 0.15 * height, x1 - 1.5, y0 + 0.15 * height + 1.4), BLACK)
        rows = max(3, int(0.8 * height / 5))
        rng = np.random.default_rng(seed)
        for i in range(rows):
            y = y0 + (0.19 + 0.79 * i / rows) * height
            step = 0.79 * height / rows
            top, low = y + 0.25 * step, y + 0.65 * step
            self.rect((x0 + 2, top, x0 + 2 + width * rng.uniform(0.25, 0.5), low), BLACK)
            self.rect((x1 - 2 - width * rng.uniform(0.1, 0.18), top, x1 - 2, low), BLACK)
            self.rect((x0 + 1.5, y + 0.92 * step, x1 - 1.5, y + step), GREY)
        return self

    def burst(
        self, x: float, y: float, outer: float, inner: float, color: Color, points: int = 16
    ) -> "Canvas":
        """Print a star burst."""
        angle = np.arange(2 * points) * np.pi / points
        radius = np.where(np.arange(2 * points) % 2 == 0, outer, inner)
        tips = zip(x + radius * np.sin(angle), y - radius * np.cos(angle), strict=True)
        return self.polygon(list(tips), color)

    def cracker(self, x: float, y: float, size: float, turn_deg: float) -> "Canvas":
        """Print a square cracker with its holes."""
        turn, middle = np.deg2rad(turn_deg), np.array([x, y])
        R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        teeth = np.linspace(-1, 1, 9)
        edge = [(t, -1.0 + 0.07 * (i % 2)) for i, t in enumerate(teeth)]
        outline = []
        for k in range(4):
            quarter = np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), k)
            outline += [tuple(quarter @ np.array(p)) for p in edge[:-1]]
        for grow, color in ((1.05, (150, 82, 20)), (1.0, (226, 150, 50)), (0.82, (240, 178, 76))):
            corners = [middle + R @ np.array(p) * size / 2 * grow for p in outline]
            self.polygon([tuple(corner) for corner in corners], color)
        for hole in np.array([(i, j) for i in (-0.45, 0.0, 0.45) for j in (-0.45, 0.0, 0.45)]):
            cx, cy = middle + R @ hole * size / 2
            self.ellipse(cx, cy, size * 0.035, size * 0.035, (140, 78, 24))
        return self
