"""Split polygons into triangles."""

import numpy as np

_MOST_WORK = 1e7  # squared corners of concave polygons of one size, together
_MOST_TRIED = 2e8  # corners that the ears of a file's polygons are compared with: half a minute
_OVERHEAD = 100  # of a comparison, in corners
_FLAT = 1e-9  # of a polygon's area: a corner that turns back by less is straight


class Effort:
    """What is spent on the concave polygons of a file: some take the cube of their corners."""

    def __init__(self) -> None:
        self._tried = 0

    def spend(self, corners: int) -> None:
        """Count corners that one was compared with.  Raises ValueError where they are too many."""
        self._tried += corners
        if self._tried > _MOST_TRIED:
            raise ValueError("concave faces that take too long to split; triangulate them")


def triangulate(points: np.ndarray, effort: Effort | None = None) -> np.ndarray:
    """Split polygons of the same number of corners: convex ones as fans, others by clipping ears.

    Args:
        points: (M, n, 3) corners in their order; nearly flat, and without crossing themselves.
        effort: Of the file that they are in; None: its own.

    Returns:
        (M, n - 2, 3) which corners make the triangles, in the polygon's sense of rotation.

    Raises:
        ValueError: Concave polygons have so many corners that it would take too long.
    """
    count = points.shape[1]
    rest = np.arange(1, count - 1)
    fan = np.stack([np.zeros_like(rest), rest, rest + 1], axis=1)
    out = np.tile(fan, (len(points), 1, 1))
    concave = np.flatnonzero(_find_concave(points))
    if len(concave) * count**2 > _MOST_WORK:
        raise ValueError(f"{len(concave):,} concave faces of {count:,} corners; triangulate them")
    effort = effort or Effort()
    for one in concave:
        out[one] = _clip_ears(_flatten(points[one]), effort)
    return out


def _areas(points: np.ndarray) -> np.ndarray:
    """Return the vector areas of polygons (Newell), twice.  (..., n, 3) -> (..., 3)."""
    near = points - points.mean(axis=-2, keepdims=True)
    return np.cross(near, np.roll(near, -1, axis=-2)).sum(axis=-2)


def _find_concave(points: np.ndarray) -> np.ndarray:
    """Return which polygons have a corner that turns back.  (M, n, 3) -> (M,) bool."""
    edges = np.roll(points, -1, axis=1) - points
    turns = np.cross(np.roll(edges, 1, axis=1), edges)
    area = _areas(points)
    against = (turns * area[:, None]).sum(-1)
    back = (against < -_FLAT * (area**2).sum(-1, keepdims=True)).any(axis=1)
    # beside a doubled corner no turn is seen
    return np.asarray(back | (edges == 0).all(-1).any(axis=1))


def _flatten(points: np.ndarray) -> np.ndarray:
    """Return a polygon in its plane, counter-clockwise.  (n, 3) -> (n, 2)."""
    normal = _areas(points)
    across = np.eye(3)[np.abs(normal).argmin()]
    x = np.cross(across, normal)
    y = np.cross(normal, x)
    basis = np.stack([x / max(np.linalg.norm(x), 1e-300), y / max(np.linalg.norm(y), 1e-300)])
    return (points - points[0]) @ basis.T


def _clip_ears(flat: np.ndarray, effort: Effort) -> np.ndarray:
    """Split a counter-clockwise polygon (n, 2).  -> (n - 2, 3)."""
    left = list(range(len(flat)))
    out = []
    while len(left) > 3:
        ear = next((at for at in range(len(left)) if _is_ear(flat, left, at, effort)), 0)
        out.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return np.array([*out, left])


def _is_ear(flat: np.ndarray, left: list[int], at: int, effort: Effort) -> bool:
    """Return whether the corner is convex, and no other lies in its triangle."""
    names = [left[at - 1], left[at], left[(at + 1) % len(left)]]
    effort.spend(_OVERHEAD)
    a, b, c = flat[names]
    if (a == b).all():
        return True
    if _cross(b - a, c - b) <= 0:
        return False
    effort.spend(len(left))
    others = flat[[one for one in left if one not in names]]
    # corners that share a place with one of the triangle's do not lie in it: holes are cut so
    apart = (others[:, None] != np.stack([a, b, c])).any(-1).all(-1)
    inside = [_cross(end - start, others - start) >= 0 for start, end in ((a, b), (b, c), (c, a))]
    return not bool((np.logical_and.reduce(inside) & apart).any())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
