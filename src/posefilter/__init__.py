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
    from posefilter import figures as figures
    from posefilter.api import (
        build as build,
    )
    from posefilter.api import (
        build_data as build_data,
    )
    from posefilter.api import (
        compose as compose,
    )
    from posefilter.api import (
        load as load,
    )
    from posefilter.belief import Belief as Belief
    from posefilter.belief import Mode as Mode
    from posefilter.belief import PoseSet as PoseSet
    from posefilter.cli.trust import trust as trust
    from posefilter.confidence.tolerance import PoseTolerance as PoseTolerance
    from posefilter.confidence.verdicts import Costs as Costs
    from posefilter.errors import UserError as UserError
    from posefilter.estimator import Estimator as Estimator
    from posefilter.result import Result as Result
    from posefilter.tracking.settings import TrackerSettings as TrackerSettings
    from posefilter.tracking.track import TrackResult as TrackResult
    from posefilter.tracking.tracker import Tracker as Tracker

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
    "trust": "cli.trust",
}
__all__ = ["__version__", *_HOMES]
__getattr__ = import_lazily(__name__, _HOMES)


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted(__all__)
