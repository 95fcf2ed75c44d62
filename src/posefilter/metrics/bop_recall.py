"""The average recall of the BOP challenge since 2019: the mean of those by VSD, MSSD and MSPD
(Hodan et al. 2020, "BOP Challenge 2020 on 6D Object Localization", section 2).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from posefilter.metrics.bop import MSPD_THRESHOLDS, MSSD_THRESHOLDS
from posefilter.metrics.matching import match_greedily
from posefilter.metrics.vsd import VSD_THRESHOLDS


class TargetErrors(NamedTuple):
    """The errors of estimates of one class in one image; the most confident estimate is the first.

    There are no more estimates than instances that are to be found.
    """

    vsd: np.ndarray  # (E, T, misalignments) in [0, 1]
    mssd: np.ndarray  # (E, T) in diameters
    mspd: np.ndarray  # (E, T) [px] of an image 640 wide


def compute_average_recall(targets: Sequence[TargetErrors]) -> dict[str, float]:
    """Return the average recall, and those of the three errors.

    For each threshold, and of VSD for each misalignment too, estimates are matched to instances
    anew; the recall is the share of all instances that are matched.

    Args:
        targets: Of all images and classes.

    Returns:
        {"ar", "ar_vsd", "ar_mssd", "ar_mspd"} in [0, 100]; NaN without instances.
    """
    total = sum(one.mssd.shape[1] for one in targets)
    if total == 0:
        return dict.fromkeys(("ar", "ar_vsd", "ar_mssd", "ar_mspd"), float("nan"))

    def recall(errors: Sequence[np.ndarray], thresholds: Sequence[float]) -> float:
        hits = [len(match_greedily(one, limit)) for one in errors for limit in thresholds]
        return 100 * sum(hits) / (total * len(thresholds))

    layers = range(targets[0].vsd.shape[2])
    by_tau = [recall([one.vsd[..., k] for one in targets], VSD_THRESHOLDS) for k in layers]
    out = {
        "ar_vsd": float(np.mean(by_tau)),
        "ar_mssd": recall([one.mssd for one in targets], MSSD_THRESHOLDS),
        "ar_mspd": recall([one.mspd for one in targets], MSPD_THRESHOLDS),
    }
    return {"ar": float(np.mean(list(out.values()))), **out}
