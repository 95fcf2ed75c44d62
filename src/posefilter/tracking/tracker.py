"""Objects followed through a video: `posefilter.Tracker`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from posefilter.errors import UserError
from posefilter.estimator import Estimator, get_trained_size
from posefilter.images import Images, check_images, check_intrinsics
from posefilter.tracking.settings import TrackerSettings
from posefilter.tracking.track import Track, TrackResult


class Tracker:
    """Follow objects from frame to frame: the belief of one frame is where the next one starts.

    ```python
    tracker = posefilter.Tracker(posefilter.load("003_cracker_box"))
    for rgb, depth in frames:
        result = tracker.update(rgb, depth, intrinsics)
        if result.found:
            result.pose, result.covariance
    ```

    The first frame is estimated as a single image is. Later ones are measured by a filter of few
    particles that starts from the belief of the frame before, moved by a random walk. What is lost
    is searched for in every frame, and found again by itself.

    Args:
        estimator: What `posefilter.load` returns, for one object or several; or a list of these.
        settings: Of the tracker; None: the defaults.
        seed: Decides every random draw: the same frames and seed give the same answers.

    Raises:
        UserError: A method's particles are no poses, or it cannot score or propose poses.
    """

    def __init__(
        self,
        estimator: Estimator | Sequence[Estimator],
        settings: TrackerSettings | None = None,
        seed: int = 0,
    ) -> None:
        estimators = [estimator] if isinstance(estimator, Estimator) else [*estimator]
        methods = [method for one in estimators for method in one.methods]
        if not methods:
            raise UserError("a tracker needs an estimator of one object at least")
        self.settings = settings or TrackerSettings()
        self.tracks = tuple(
            Track(
                method,
                get_trained_size(method.recipe.get("settings", {})),
                self.settings,
                seed,
            )
            for method in methods
        )
        self._size: tuple[int, ...] | None = None

    @property
    def objects(self) -> tuple[str, ...]:
        """The names of the objects, in the order of the results."""
        return tuple(track.method.model.name for track in self.tracks)

    def update(self, rgb: Any, depth: Any, intrinsics: Any) -> Any:
        """Find each object in the next frame.

        Args:
            rgb: Color (H, W, 3) or (3, H, W), RGB, as a numpy array or tensor: uint8, or float in
                [0, 1].
            depth: z-depth (H, W) in meters, as float, aligned with the color; 0 or NaN where
                unknown. After the first frame it may be unknown everywhere.
            intrinsics: Camera matrix (3, 3) [px] of this frame.

        Returns:
            A `TrackResult` where there is one object, else a list of them.

        Raises:
            UserError: The frame is not as it should be.
        """
        results = self.update_all(rgb, depth, intrinsics)
        return results[0] if len(results) == 1 else results

    def update_all(self, rgb: Any, depth: Any, intrinsics: Any) -> list[TrackResult]:
        """Find each object in the next frame; as `update`, but always a list."""
        images = self._check(rgb, depth, intrinsics)
        return [track.update(images) for track in self.tracks]

    def reset(self) -> None:
        """Forget all objects: the next frame is the first of another video."""
        self._size = None
        for track in self.tracks:
            track.reset()

    def _check(self, rgb: Any, depth: Any, intrinsics: Any) -> Images:
        """Return a frame in one form; all is checked of the first, and the shapes of the others."""
        fast = (
            isinstance(rgb, np.ndarray)
            and isinstance(depth, np.ndarray)
            and rgb.dtype == np.uint8
            and depth.dtype.kind == "f"
            and rgb.shape == (*depth.shape, 3)
            and depth.shape == self._size
        )
        if fast:
            return Images(rgb[None], depth[None], check_intrinsics(np.asarray(intrinsics), 1))
        images, batched = check_images(rgb, depth, intrinsics, empty=self._size is not None)
        if batched:
            raise UserError("rgb: a tracker takes one frame after the other, not a batch")
        self._size = images.depth.shape[1:]
        return images
