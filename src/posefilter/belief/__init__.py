"""A belief over one object's pose in one image, as numbers: what `Estimator.predict` hands back."""

from posefilter.belief.belief import Belief
from posefilter.belief.sets import PoseSet
from posefilter.belief.summaries import Marginal, Mode, Projection, Uncertainty

__all__ = ["Belief", "Marginal", "Mode", "PoseSet", "Projection", "Uncertainty"]
