"""A verdict from probabilities, by what an error costs: the reject option of Chow (1970).

References:
    Chow: On optimum recognition error and reject tradeoff. IEEE Transactions on Information Theory
        16 (1970).
    Saerens, Latinne, Decaestecker: Adjusting the outputs of a classifier to new a priori
        probabilities. Neural Computation 14 (2002).
"""

from dataclasses import dataclass, fields
from numbers import Real
from typing import Literal

import torch
from torch import Tensor

from posefilter.confidence.calibration import Assessment
from posefilter.errors import UserError, check_positive

Verdict = Literal["found", "unsure", "absent"]


@dataclass(frozen=True)
class Costs:
    """What errors cost; only their ratios count.

    Attributes:
        false_alarm: Of declaring a pose that is wrong, or of an object that is not there.
        miss: Of declaring an object absent that is there.
        unsure: Of declaring nothing, such as another look.

    Raises:
        UserError: One is not a positive number.
    """

    false_alarm: float = 5.0
    miss: float = 5.0
    unsure: float = 1.0

    def __post_init__(self) -> None:
        """Check that the costs are positive."""
        for field in fields(self):
            check_positive(f"cost_{field.name}", getattr(self, field.name))


def check_costs(given: object) -> None:
    """Raise UserError unless costs are `Costs`, or None."""
    if not isinstance(given, Costs | None):
        raise UserError(f"costs={given!r}: expected posefilter.Costs(...)")


def decide(presence: float, probability: float, costs: Costs | None = None) -> Verdict:
    """Return the verdict of least expected cost.

    "found" costs `false_alarm` with probability 1 - `probability`, "absent" costs `miss` with
    probability `presence`, "unsure" always costs `unsure`. Of equal costs "unsure" is chosen
    first, then "absent".

    Args:
        presence: Probability that the object is there.
        probability: Probability that it is there and the pose right; at most `presence`.
        costs: What errors cost; None: the default.
    """
    costs = costs or Costs()
    expected: dict[Verdict, float] = {
        "unsure": costs.unsure,
        "absent": presence * costs.miss,
        "found": (1 - probability) * costs.false_alarm,
    }
    return min(expected, key=lambda verdict: expected[verdict])


def describe_probability(probability: float) -> str:
    """Return a probability in two digits, none nearer to 0 or 1 than 0.01: some hundred calibration
    frames do not tell more.
    """
    return f"{min(max(probability, 0.01), 0.99):.2f}"


def apply_prior(presence: float, probability: float, prior: float) -> tuple[float, float]:
    """Return presence and probability for images that show the object more or less often than not.

    A calibration counts frames with the object and without as if there were as many of each. By
    Bayes' rule another prior multiplies the odds of the presence by its own odds (Saerens, Latinne
    and Decaestecker 2002); whether the pose is right, given that the object is there, stays.

    Args:
        presence: Probability that the object is there, as calibrated.
        probability: Probability that it is there and the pose right; at most `presence`.
        prior: Share of the images that show the object, in (0, 1).

    Raises:
        UserError: The prior is not between 0 and 1.
    """
    number = isinstance(prior, Real) and not isinstance(prior, bool)
    if not (number and 0 < prior < 1):
        raise UserError(f"prior={prior!r}: must lie between 0 and 1, ends excluded")
    there, absent = prior * presence, (1 - prior) * (1 - presence)
    adjusted = there / (there + absent)
    return adjusted, probability * adjusted / presence if presence else 0.0


def score_verdicts(found: Assessment, costs: Costs | None = None) -> Tensor:
    """Return the verdicts on B estimates as numbers, (B,) float64: 1 found, 0 unsure, -1 absent."""
    number = {"found": 1.0, "unsure": 0.0, "absent": -1.0}
    pairs = zip(found.presence.tolist(), found.probability.tolist(), strict=True)
    return torch.tensor([number[decide(q, p, costs)] for q, p in pairs], dtype=torch.float64)
