"""Objects followed through a video: `posefilter.Tracker`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from posefilter.devices import take_threads
from posefilter.errors import UserError, check_seed
from posefilter.estimator import Estimator, get_trained_size
from posefilter.images import Images, as_array, check_depth_unit, check_images, check_intrinsics
from posefilter.precision import in_float32
from posefilter.tracking.processes import MultiprocessTracker
from posefilter.tracking.settings import TrackerSettings
from posefilter.tracking.track import Track, TrackResult
from posefilter.tracking.window import Frame


class Tracker:
    """Follow objects from frame to frame: the belief of one frame is where the next one starts.

    ```python
    tracker = posefilter.Tracker(posefilter.load("003_cracker_box"))
    for rgb, depth in frames:
        result = tracker.update(rgb, depth, intrinsics)
        if result.is_tracked:
            result.pose, result.covariance
    ```

    The first frame is estimated as a single image is. Later ones are measured by a filter of few
    particles that starts from the belief of the frame before, moved by a motion model of constant
    velocity. What is lost is searched for, and recovered by itself.

    Args:
        estimator: What `posefilter.load` returns, for one object or several; or a list of these.
            Verdicts go by its costs and its pose tolerance.
        settings: Of the tracker; None: the defaults.
        seed: Decides every random draw: the same frames and seed give the same answers.
        threads: Cores to track on. Several objects are then tracked side by side, by this process
            and others that it starts, an object each at a time. What of the cores remains an
            operation may use: that is set for the whole process, as `torch.set_num_threads` does.
            None: one object after the other, on the threads that torch uses anyway; so it is on a
            GPU, too. The other processes end with `close`, with the tracker, or with this process.

    Raises:
        UserError: A method's particles are no poses, or it cannot score or propose poses; or
            `threads` is no whole number, 1 or more; or a method cannot be sent to a process.
    """

    def __init__(
        self,
        estimator: Estimator | Sequence[Estimator],
        settings: TrackerSettings | None = None,
        seed: int = 0,
        threads: int | None = None,
    ) -> None:
        estimators = [estimator] if isinstance(estimator, Estimator) else estimator
        if not isinstance(estimators, (list, tuple)) or not all(
            isinstance(one, Estimator) for one in estimators
        ):
            raise UserError("a tracker needs what posefilter.load returns, or a list of such")
        pairs = [(one, method) for one in estimators for method in one.methods]
        if not pairs:
            raise UserError("a tracker needs an estimator of one object at least")
        seed = check_seed(seed)
        if not isinstance(settings, TrackerSettings | None):
            raise UserError(f"settings={settings!r}: expected posefilter.TrackerSettings(...)")
        self.settings = settings or TrackerSettings()
        self.tracks = tuple(
            Track(
                method,
                get_trained_size(method.recipe.get("settings", {})),
                self.settings,
                seed,
                phase,
                multi_object=len(pairs) > 1,
                costs=one.costs,
                pose_tolerance=one.pose_tolerance,
            )
            for phase, (one, method) in enumerate(pairs)
        )
        self._others = _open_processes(self.tracks, threads)
        self._size: tuple[int, ...] | None = None

    @property
    def objects(self) -> tuple[str, ...]:
        """The names of the objects, in the order of the results."""
        return tuple(track.method.object_model.name for track in self.tracks)

    def update(self, rgb: Any, depth: Any, intrinsics: Any) -> Any:
        """Find each object in the next frame.

        Args:
            rgb: Color (H, W, 3) or (3, H, W), RGB, as a numpy array or tensor: uint8, or float in
                [0, 1].
            depth: z-depth (H, W) in meters, as float, aligned with the color; 0 or NaN where
                unknown. Where it is unknown everywhere, or the color is one, the frame counts as
                one that does not show the object; `TrackResult.blank` says so.
            intrinsics: Camera matrix (3, 3) [px] of this frame.

        Returns:
            A `TrackResult` where there is one object, else a list of them.

        Raises:
            UserError: The frame is not as it should be.
        """
        results = self.update_all(rgb, depth, intrinsics)
        return results[0] if len(results) == 1 else results

    @in_float32
    def update_all(self, rgb: Any, depth: Any, intrinsics: Any) -> list[TrackResult]:
        """Find each object in the next frame; as `update`, but always a list."""
        frame = Frame(self.check(rgb, depth, intrinsics))
        take_threads()
        if self._others is not None:
            return self._others.update(frame)
        return [track.update(frame) for track in self.tracks]

    def wait(self) -> None:
        """Wait until the other processes have started. Until then this one tracks all objects."""
        if self._others is not None:
            self._others.wait()

    def close(self) -> None:
        """End the other processes. The tracker can still be used, without them."""
        if self._others is not None:
            self._others.close()

    def __enter__(self) -> "Tracker":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self) -> None:
        """Forget all objects: the next frame is the first of another video."""
        self._size = None
        for track in self.tracks:
            track.reset()

    def check(self, rgb: Any, depth: Any, intrinsics: Any) -> Images:
        """Return a frame in one form; all is checked of the first, and the shapes of the others.

        Raises:
            UserError: The frame is not as it should be.
        """
        fast = (
            type(rgb) is type(depth) is np.ndarray  # a masked array's mask says what is unknown
            and rgb.dtype == np.uint8
            and depth.dtype.kind == "f"
            and rgb.shape == (*depth.shape, 3)
            and depth.shape == self._size
        )
        if fast:
            check_depth_unit(depth)
            K = check_intrinsics(as_array(intrinsics, "intrinsics"), 1, depth.shape)
            return Images(rgb[None], depth[None], K)
        images, batched = check_images(rgb, depth, intrinsics, empty=True)
        if batched:
            raise UserError("rgb: a tracker takes one frame after the other, not a batch")
        self._size = images.depth.shape[1:]
        return images


def _open_processes(tracks: Sequence[Track], threads: int | None) -> MultiprocessTracker | None:
    """Start processes for objects side by side; None where there is nothing to share out."""
    if threads is None:
        return None
    if not isinstance(threads, int) or isinstance(threads, bool) or threads < 1:
        raise UserError(f"threads={threads}: must be a whole number, 1 or more")
    if any(track.method.device.type != "cpu" for track in tracks):
        return None
    processes = min(threads, len(tracks))
    torch.set_num_threads(threads // processes)
    return None if processes == 1 else MultiprocessTracker(tracks, processes, threads // processes)
