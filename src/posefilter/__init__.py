"""posefilter: 6-DoF object pose, and a belief over it, from RGB-D images with learned particle
filters.

```python
import posefilter

estimator = posefilter.load("003_cracker_box")
result = estimator.predict(rgb, depth, intrinsics)
result.verdict, result.probability, result.pose, result.covariance, result.belief
```

Public names are imported when they are first used: `import posefilter` does not import torch.
"""

from typing import TYPE_CHECKING

from posefilter.lazy import import_lazily

__version__ = "0.1.0"

if TYPE_CHECKING:
    from posefilter import figures
    from posefilter.api import build, build_data, compose, load, load_method
    from posefilter.belief import Belief, Mode, PoseSet
    from posefilter.cli.trust import trust
    from posefilter.confidence.tolerance import PoseTolerance
    from posefilter.confidence.verdicts import Costs
    from posefilter.errors import UserError
    from posefilter.estimator import Estimator
    from posefilter.geometry.lens import undistort
    from posefilter.result import Result
    from posefilter.tracking.settings import TrackerSettings
    from posefilter.tracking.track import TrackResult
    from posefilter.tracking.tracker import Tracker

__all__ = [
    "Belief",
    "Costs",
    "Estimator",
    "Mode",
    "PoseSet",
    "PoseTolerance",
    "Result",
    "TrackResult",
    "Tracker",
    "TrackerSettings",
    "UserError",
    "__version__",
    "build",
    "build_data",
    "compose",
    "figures",
    "load",
    "load_method",
    "trust",
    "undistort",
]

_HOMES = {
    "Belief": "belief",
    "Costs": "confidence.verdicts",
    "Estimator": "estimator",
    "Mode": "belief",
    "PoseSet": "belief",
    "PoseTolerance": "confidence.tolerance",
    "Result": "result",
    "TrackResult": "tracking.track",
    "Tracker": "tracking.tracker",
    "TrackerSettings": "tracking.settings",
    "UserError": "errors",
    "build": "api",
    "build_data": "api",
    "compose": "api",
    "figures": "figures",
    "load": "api",
    "load_method": "api",
    "trust": "cli.trust",
    "undistort": "geometry.lens",
}
__getattr__ = import_lazily(__name__, _HOMES)


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted(__all__)
