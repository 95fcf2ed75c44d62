"""How well a probability tells right from wrong, and whether it means what it says."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from posefilter.metrics.collect import Rows
from posefilter.metrics.diagnostics import auroc

COVERAGE = 0.8  # share of the images that are kept where an error rate is given
_BINS = 10


def calibration_error(probability: Tensor, correct: Tensor, bins: int = _BINS) -> Tensor:
    """Return the expected calibration error (Naeini et al. 2015).

    The mean over bins of equal width, weighted by their number of predictions, of |mean probability
    - share that is right|. With n predictions a perfect forecaster has an error of about
    sqrt(bins / n) / 4, so that few tell little.

    (M,), (M,) bool -> (); NaN without predictions.
    """
    known = list_bins(probability, correct, bins)
    gaps = [one["frames"] * abs(one["probability"] - one["right"]) for one in known]
    return torch.tensor(sum(gaps) / len(probability) if gaps else torch.nan, dtype=torch.float64)


def list_bins(probability: Tensor, correct: Tensor, bins: int = _BINS) -> list[dict[str, float]]:
    """Return the reliability diagram: of each bin that is not empty its ends, its number of frames,
    mean probability and share that is right. A probability at a limit is of the bin above.

    (M,), (M,) bool.
    """
    probability = probability.double()
    bin_of_each = (probability * bins).long().clamp(0, bins - 1)
    out = []
    for k in bin_of_each.unique().tolist():
        inside = bin_of_each == k
        ends = {"from": k / bins, "to": (k + 1) / bins, "frames": int(inside.sum())}
        mean, right = float(probability[inside].mean()), float(correct[inside].double().mean())
        out.append({**ends, "probability": mean, "right": right})
    return out


def error_at_coverage(probability: Tensor, correct: Tensor, coverage: float = COVERAGE) -> Tensor:
    """Return the share that is wrong among the predictions of highest probability.

    Args:
        probability: (M,).
        correct: (M,) bool.
        coverage: Share of the predictions that are kept; the rest is refused.

    Returns:
        (), NaN without predictions. Of equal probabilities all count alike.
    """
    count = len(probability)
    if not count:
        return torch.tensor(torch.nan)
    accepted = max(1, round(coverage * count))
    threshold = probability.double().sort(descending=True).values[accepted - 1]
    above, equal = probability > threshold, probability == threshold
    share = (accepted - above.sum()) / equal.sum()
    wrong = (~correct).double()
    return (wrong[above].sum() + share * wrong[equal].sum()) / accepted


class ConfidenceColumns(NamedTuple):
    """The probabilities of N frames, and what is true of them: (N,) each."""

    presence: Tensor  # probability that the object is there
    probability: Tensor  # that it is there and its pose right
    present: Tensor  # bool; the object is in the image
    correct: Tensor  # bool; and the pose within the tolerance
    verdict: Tensor  # 1 where it is found, -1 where absent, 0 where unsure


class Confidence(Rows[ConfidenceColumns]):
    """The quality of calibrated probabilities, over frames with and without the object.

    auroc: of the probability, right against wrong poses, among frames with the object.
    auroc_presence: of the presence, frames with the object against frames without. ece, brier: of
    the probability, over all frames. wrong: share of wrong poses among frames with the object;
    wrong_at_80: the same among the 80 % of highest probability. found, absent: share of the frames
    with the object that are declared so. false_alarms: number of frames without the object in which
    one is found. bins: the reliability diagram over all frames.
    """

    columns = ConfidenceColumns

    def update(
        self,
        presence: Tensor,
        probability: Tensor,
        present: Tensor,
        correct: Tensor,
        verdict: Tensor,
    ) -> None:
        """Accumulate the estimates of B frames: (B,) each, as of `ConfidenceColumns`."""
        columns = (presence, probability, present, correct, verdict)
        self.append(ConfidenceColumns(*(column.cpu() for column in columns)))

    def compute(self) -> dict[str, Any]:
        """Return the numbers; those that need frames of a kind that is missing are NaN."""
        frames = self.all()
        probability = frames.probability
        present, correct = frames.present > 0, frames.correct > 0
        probability_if_present, verdict_if_present = probability[present], frames.verdict[present]
        return {
            "frames": int(present.sum()),
            "frames_without": int((~present).sum()),
            "auroc": float(auroc(probability_if_present, correct[present])),
            "auroc_presence": float(auroc(frames.presence, present)),
            "ece": float(calibration_error(probability, correct)),
            "brier": float((probability - frames.correct).square().mean()),
            "wrong": float((1 - frames.correct[present]).mean()),
            "wrong_at_80": float(error_at_coverage(probability_if_present, correct[present])),
            "found": float((verdict_if_present > 0).double().mean()),
            "absent": float((verdict_if_present < 0).double().mean()),
            "false_alarms": int((frames.verdict[~present] > 0).sum()),
            "bins": list_bins(probability, correct),
        }
