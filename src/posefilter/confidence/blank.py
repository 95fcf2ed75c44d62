"""Whether an image shows anything that could be judged.

A covered lens, a file that is not the right one, or colors that were divided by 255 twice give an
image of one color. The filter still answers, from the depth alone, and the calibration knows no
such image: what it says of one is not to be believed, neither "found" nor "absent".
"""

import cv2
import numpy as np

from posefilter.limits import FEWEST_KNOWN

# averaged over squares of 8 px, so that a sensor's noise is no contrast
_SIDE = 8
_CONTRAST = 10 / 255  # 1,500 renders have 49 / 255 at least, photographs more
_RELIEF = 0.005  # [m]; the same renders have 0.07 at least


def find_blank(rgb: np.ndarray, depth: np.ndarray) -> str:
    """Return why an image cannot be judged, in words; "" where it can be.

    Args:
        rgb: (H, W, 3) uint8, or float in [0, 1].
        depth: z-depth (H, W) [m], 0 or not finite where unknown.
    """
    height, width = rgb.shape[:2]
    size = (max(1, width // _SIDE), max(1, height // _SIDE))
    coarse = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
    white = 255 if rgb.dtype == np.uint8 else 1
    if float(np.ptp(coarse, axis=0).max()) / white < _CONTRAST:
        brightness = float(coarse.mean()) / white
        dark = "black (a covered lens, or colors divided by 255 twice?)"
        color = dark if brightness < _CONTRAST else "of one color (is it the right file?)"
        return f"the color image is {color}, so that nothing can be judged by it"
    some = depth[::_SIDE, ::_SIDE]
    some = some[np.isfinite(some) & (some > 0)]
    if len(some) >= FEWEST_KNOWN * depth.size and float(np.ptp(some)) >= _RELIEF:
        return ""  # as of nearly all images, without looking at each pixel
    known = depth[np.isfinite(depth) & (depth > 0)]
    if len(known) < FEWEST_KNOWN * depth.size:
        return (
            f"{len(known)} of {depth.size} pixels have depth (a covered sensor, or not the right "
            "file?), so that nothing can be judged by it"
        )
    if float(np.ptp(known)) < _RELIEF:
        return (
            f"the depth is {float(known.mean()):.3g} m everywhere (is it the right file?), so that "
            "nothing can be judged by it"
        )
    return ""
