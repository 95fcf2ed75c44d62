"""The data of an experiment: one reader, its splits by scene, and loaders."""

import logging
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from lightning import LightningDataModule
from torch.utils.data import DataLoader

from posefilter.data.absent import annotates_one_class, deal_images, find_absent
from posefilter.data.cache import CACHES, FrameCache, open_cache
from posefilter.data.dataset import EpochShuffle, FrameDataset, ResumableLoader
from posefilter.data.decoding import FrameDecoder
from posefilter.data.frames import FrameRecord
from posefilter.data.generated_scenes import ensure_scenes
from posefilter.data.loaders import count_batches, make_loader, spare_cores
from posefilter.data.points import read_model_points
from posefilter.data.readers.base import BaseReader
from posefilter.data.readers.registry import open_meshes, open_reader, open_whole
from posefilter.data.splits import NAMES, Share, split_records
from posefilter.errors import UserError
from posefilter.meshes.store import BUILTIN, MeshStore, object_model
from posefilter.meshes.texture import TEXTURE_POINTS, add_texture
from posefilter.ranges import check_ranges
from posefilter.types import Batch, ObjectModel

if TYPE_CHECKING:
    from posefilter.data.augmentation import Augment

log = logging.getLogger(__name__)

_USUAL_WIDTH = 640  # [px] of a camera's image, three quarters of that high
_IMAGE_BYTES = 5  # of a pixel of color and depth, as they are kept
_STAGES = {
    "fit": ("train", "val"),
    "validate": ("val",),
    "test": ("test",),
    "predict": ("test",),
    None: NAMES,
}


class PoseDataModule(LightningDataModule):
    """Frames of one dataset with the chosen objects: split by scene, resized, cached, augmented."""

    def __init__(
        self,
        source: str,
        root: str | Path | None,
        object: str | Sequence[str] | None = None,
        meshes: str | Path | MeshStore = BUILTIN,
        mesh_scale: float | None = None,
        image_width: int | None = None,
        image_height: int | None = None,
        split: Mapping[str, Share | None] | None = None,
        split_seed: int = 0,
        min_visibility: float = 0.0,
        min_visibility_test: float = 0.0,
        batch_size: int = 8,
        batch_size_test: int | None = None,
        workers: int | None = 0,
        seed: int = 0,
        augment: "Augment | None" = None,
        cache: str = "memory",
        cache_dir: str | Path | None = None,
        on_error: str = "raise",
        limit_train: int | None = None,
        limit_val: int | None = None,
        limit_test: int | None = None,
        num_model_points: int = 2000,
        texture_points: int = TEXTURE_POINTS,
        model_points_dir: str | Path | None = None,
        generate: Callable[[Path], Any] | None = None,
        options: Mapping[str, Any] | None = None,
        progress: bool = True,
    ) -> None:
        """Set up; no file is opened before `setup`.

        Args:
            source: "scenes", "fat", "ycb_video" or "bop".
            root: The dataset's folder.
            object: A class, several, or None for all.
            meshes: "builtin", a folder or a mesh store.
            mesh_scale: Meters a unit of the mesh files; None: 0.001 for BOP's models, else 1.
            image_width: Of the images that methods see [px]; alone it keeps the aspect.
            image_height: Likewise.
            split: What train, val and test get, see `split_records`; by default 0.8, 0.1, 0.1.
            split_seed: Shuffles the scenes.
            min_visibility: Least visible share of training frames; unknown passes.
            min_visibility_test: Least visible share of val and test frames.
            batch_size: Frames of a training batch.
            batch_size_test: Frames of a val or test batch; None: as many.
            workers: Loader processes; None: see `spare_cores`.
            seed: Decides order and augmentation.
            augment: Changes training frames.
            cache: "memory", "disk" or "none".
            cache_dir: Where `disk` keeps frames; None: the dataset's own `.cache`.
            on_error: "raise", or "skip" broken frames and count them.
            limit_train: The first so many training frames of a fixed shuffle.
            limit_val: Likewise of val.
            limit_test: Likewise of test.
            num_model_points: Surface points for ADD.
            texture_points: Colored surface points that a method is given of the object it learns.
            model_points_dir: A folder with <class>/points.xyz in the dataset's own frame instead.
            generate: Called with the root where scenes are yet to be rendered.
            options: The reader's own.
            progress: Draw bars.

        Raises:
            UserError: A value is impossible.
        """
        super().__init__()
        check_ranges(locals(), "data")
        if cache not in CACHES:
            raise UserError(f"data.cache={cache}: choose {', '.join(CACHES)}")
        if root is None:
            raise UserError(f"data.root is not set: which folder holds the {source} dataset?")
        self.root, self.source = Path(root), source
        self._object, self._meshes, self._mesh_scale = object, meshes, mesh_scale
        self._options, self._generate = dict(options or {}), generate
        self._image_width, self._image_height = image_width, image_height
        self._split = dict(split or {"train": 0.8, "val": 0.1, "test": 0.1})
        self._split_seed = split_seed
        self._least = dict.fromkeys(NAMES, min_visibility_test) | {"train": min_visibility}
        self._limits = {"train": limit_train, "val": limit_val, "test": limit_test}
        self._batch_size, self._batch_size_test = batch_size, batch_size_test or batch_size
        self._workers = spare_cores() if workers is None else workers
        self._seed, self._augment, self._on_error = seed, augment, on_error
        self._cache_kind, self._cache_dir = cache, cache_dir
        self._num_model_points, self._model_points_dir = num_model_points, model_points_dir
        self._texture_points = texture_points
        self._progress = progress
        self._datasets: dict[str, FrameDataset] = {}
        self._noted = set[str]()  # what the log has of the reader's notes
        self._left_out: dict[str, Counter[str]] = {}

    @cached_property
    def meshes(self) -> MeshStore:
        """The mesh store."""
        if isinstance(self._meshes, MeshStore):
            return self._meshes
        frame = self._options.get("mesh_frame")
        return open_meshes(self._meshes, self._mesh_scale, self.source, self._object, frame)

    @cached_property
    def reader(self) -> BaseReader:
        """The dataset's reader."""
        return open_reader(
            self.source, self.root, self._object, self.meshes, self._on_error, **self._options
        )

    @property
    def objects(self) -> tuple[str, ...]:
        """The classes; a batch's `object_id` is an index into them."""
        return self.reader.objects

    @cached_property
    def _parts(self) -> dict[str, list[int]]:
        """The indices of each split's records, before any frame is decoded."""
        if not self._records and self._object is not None:
            raise UserError(
                f"data.object={self._object}: no frame in {self.root} (data.root) shows it"
            )
        return split_records(self._records, self._split, self._split_seed, self.root)

    @cached_property
    def _records(self) -> Sequence[FrameRecord]:
        return self.reader.records()

    @cached_property
    def _decoder(self) -> FrameDecoder:
        size = self._image_width, self._image_height
        options = sorted(self._options.items())
        root = str(self.meshes.root)
        root = root if root == BUILTIN else str(Path(root).resolve())
        meshes = (root, self.meshes.describe_files(self.objects))
        content = (
            self.source,
            self.root.resolve(),
            self.objects,
            meshes,
            "{}x{}".format(*size),
            options,
        )
        folder = Path(self._cache_dir or self.root / ".cache")
        cache = partial(open_cache, self._cache_kind, folder, f"1 {content}")
        return self._make_decoder(self.reader, self._records, cache)

    def _make_decoder(
        self, reader: BaseReader, records: Sequence[FrameRecord], cache: Callable[..., FrameCache]
    ) -> FrameDecoder:
        size = self._image_width, self._image_height
        return FrameDecoder(reader, records, *size, cache, max(self._workers, 2), self._progress)

    def prepare_data(self) -> None:
        """Render the scenes if the source is `scenes` and they do not exist yet."""
        if self.source == "scenes":
            ensure_scenes(self.root, self._generate)

    def render(self) -> None:
        """Render what the scenes lack, also of a dataset that was finished with fewer frames."""
        if self._generate is not None:
            self._generate(self.root)

    def setup(self, stage: str | None = None) -> None:
        """List, split and decode the frames that a stage needs."""
        for name in _STAGES[stage]:
            if name not in self._datasets:
                self._datasets[name] = self._prepare(name)
                log.info("%s", self._summarize(name))
        for note, count in self.reader.notes.items():
            if note not in self._noted:
                log.warning("%s%s", note, f" ({count})" if count > 1 else "")
                self._noted.add(note)

    def object_model(self, object_id: int) -> ObjectModel:
        """Return a class as methods and metrics use it.

        Raises:
            UserError: The dataset has photographs, and meshes are the built-in ones; or it says
                that the object has another diameter than its mesh, or brings points of it in
                another unit.
        """
        name = self.objects[object_id]
        if self.source in ("ycb_video", "bop") and str(self.meshes.root) == BUILTIN:
            raise UserError(
                f"{name}: builtin meshes are not the objects of real photographs; "
                f"give data.meshes=DIR"
            )
        mesh, native = self.meshes.load(name), self.reader.native_from_mesh(name)
        points, folder = None, self._model_points_dir
        # of other datasets such points, where they lie beside one, are of another frame
        if folder is not None or self.source == "ycb_video":
            points = read_model_points(folder, self.root, name, native, mesh.bounds)
        found = object_model(mesh, points=points, count=self._num_model_points)
        self.reader.check_diameter(name, found.diameter)
        return found

    def object_to_learn(self) -> ObjectModel:
        """Return the first class as a method learns it: with the texture of its mesh.

        Raises:
            UserError: As `object_model`.
        """
        mesh = self.meshes.load(self.objects[0])
        return add_texture(self.object_model(0), mesh, self._texture_points)

    def records(self, split: str) -> list[FrameRecord]:
        """Return the records of a split: a batch's `frame_id` is an index into them."""
        return self._dataset(split).records

    @property
    def train_dataset(self) -> FrameDataset:
        """The training frames, augmented."""
        return self._dataset("train")

    @property
    def val_dataset(self) -> FrameDataset:
        """The validation frames.

        Raises:
            UserError: The split leaves none.
        """
        dataset = self._dataset("val")
        if len(dataset) == 0:
            raise _lack("val, by which the best checkpoint is chosen")
        return dataset

    @property
    def test_dataset(self) -> FrameDataset:
        """The test frames.

        Raises:
            UserError: The split leaves none.
        """
        self.check_test()
        return self._dataset("test")

    def check_test(self) -> None:
        """Raise UserError where the split leaves no frames to test on; nothing is decoded."""
        if not self._parts["test"]:
            raise _lack("test")

    def absent_dataset(self, split: str, limit: int | None = None) -> FrameDataset:
        """Return images of a split in which the object is not, the first so many of a fixed
        shuffle; masks are empty, but of a plug-in's reader may be those of other objects.

        An image counts where the dataset does not list the object in it, and where its scene is of
        no other split.

        Raises:
            UserError: A file is broken, and `on_error` is "raise".
        """
        name = self._object if isinstance(self._object, str) else self.objects[0]
        reader = open_whole(self.source, self.root, [name], None, self._on_error, **self._options)
        reader.add_empty()
        reader.hide_objects()
        records = reader.records()
        try:
            own = self._records
        except UserError:
            if name in reader.objects:
                raise
            own = []  # no image of this dataset shows it
        unlisted = getattr(reader, "unlisted", ())  # a plug-in's may have none
        found = find_absent(records, own, name, unlisted)
        parts = {part: [own[i] for i in self._parts[part]] if own else [] for part in NAMES}
        found = deal_images(found, parts, split)
        if found and annotates_one_class([record for record in records if record.object]):
            log.warning(
                "%s: each image annotates one class; images that do not annotate %s may show it "
                "and count as lacking it (absent_frames=0 uses none)",
                self.root,
                name,
            )
        order = np.random.default_rng([self._split_seed, 11]).permutation(len(found))
        keep = partial(open_cache, "memory", Path(), "")
        decoder = self._make_decoder(reader, records, keep)
        title = "decoding frames without the object"
        chosen, left_out = decoder.find_usable(
            [found[i] for i in order], 0.0, limit, self._on_error, title
        )
        for reason, count in left_out.items():
            example = decoder.examples.get(reason, reason)
            log.warning("left out of the frames without %s: %s (%d such)", name, example, count)
        return FrameDataset(chosen, decoder.cache)

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return shuffled, augmented batches; of several processes, each has frames of its own."""
        dataset = self.train_dataset
        trainer = self.trainer
        place = (0, 1) if trainer is None else (trainer.global_rank, trainer.world_size)
        order = EpochShuffle(len(dataset), self._seed, dataset.set_epoch, *place)
        full = len(order) >= self._batch_size
        loader = self._make_loader(dataset, self._batch_size, sampler=order, drop_last=full)
        if trainer is not None:
            loader.batches = count_batches(len(loader), trainer.limit_train_batches)
        return loader

    def _make_loader(self, dataset: FrameDataset, size: int, **options: Any) -> ResumableLoader:
        """Return a loader of batches of a size, which a trainer may move to a GPU by CUDA."""
        for_gpu = self.trainer is not None and self.trainer.strategy.root_device.type == "cuda"
        return make_loader(dataset, size, self._workers, for_gpu=for_gpu, **options)

    def val_dataloader(self) -> DataLoader[Batch]:
        """Return validation batches in order."""
        return self._make_loader(self.val_dataset, self._batch_size_test)

    def test_dataloader(self) -> DataLoader[Batch]:
        """Return test batches in order."""
        return self._make_loader(self.test_dataset, self._batch_size_test)

    def predict_dataloader(self) -> DataLoader[Batch]:
        """Return test batches in order."""
        return self.test_dataloader()

    def split_record(self) -> dict[str, dict[str, int]]:
        """Return the scenes of each split with their number of frames."""
        records = self._records
        return {
            name: dict(sorted(Counter(records[i].group for i in part).items()))
            for name, part in self._parts.items()
        }

    def describe(self) -> dict[str, Any]:
        """Return objects, frames and scenes of each split, and the frames left out by reason."""
        splits = {
            name: {
                "frames": len(dataset),
                "images": len({record.files[0] for record in dataset.records}),
                "scenes": len({record.group for record in dataset.records}),
                "left_out": dict(self._left_out[name]),
            }
            for name, dataset in self._datasets.items()
        }
        return {
            "source": self.source,
            "root": str(self.root),
            "objects": list(self.objects),
            "records": len(self._records),
            "splits": splits,
            "left_out_while_listing": dict(self.reader.skipped),
            "notes": dict(self.reader.notes),
        }

    def _summarize(self, split: str) -> str:
        """Return a sentence about a split."""
        own = self.describe()["splits"][split]
        left = ", ".join(f"{count} for {reason}" for reason, count in own["left_out"].items())
        shown = f"{own['frames']} frames"
        if own["frames"] != own["images"]:
            shown = f"{own['frames']} instances in {own['images']} images"
        more = f"; left out: {left}" if left else ""
        return f"{split}: {shown} of {own['scenes']} scenes{more}"

    def _dataset(self, split: str) -> FrameDataset:
        if split not in NAMES:
            raise UserError(f"split '{split}': there are {', '.join(NAMES)}")
        if split not in self._datasets:
            self.setup({"train": "fit", "val": "validate", "test": "test"}[split])
        return self._datasets[split]

    def _warn_of_memory(self, images: int) -> None:
        """Warn where so many images will hardly fit into the memory that is free."""
        width = self._image_width or _USUAL_WIDTH
        needed = images * _IMAGE_BYTES * 0.75 * width * width
        try:
            free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        except (AttributeError, ValueError, OSError):  # Windows, macOS: not known
            return
        if needed > 0.7 * free:
            log.warning(
                "data.cache=memory: %d images take some %.0f GB, and %.0f GB of memory are free; "
                "data.cache=disk keeps them in files",
                images,
                needed / 1e9,
                free / 1e9,
            )

    def _prepare(self, split: str) -> FrameDataset:
        """Decode a split's frames into the cache; return those that can be used, at most the
        limit.
        """
        part, limit = self._parts[split], self._limits[split]
        if limit is not None:  # smaller limits take a part of what larger ones take
            same_as = self._split.get(split)
            first = NAMES.index(same_as if same_as in NAMES else split)
            order = np.random.default_rng([self._split_seed, first]).permutation(len(part))
            part = [part[i] for i in order]
        records = [self._records[i] for i in part]
        if self._cache_kind == "memory":
            self._warn_of_memory(len({record.name for record in records[:limit]}))
        chosen, self._left_out[split] = self._decoder.find_usable(
            records, self._least[split], limit, self._on_error, f"decoding {split} frames"
        )
        if part and not chosen and limit != 0:
            raise UserError(
                f"{self.root}: none of {len(part)} {split} frames can be used: "
                f"{dict(self._left_out[split])}"
            )
        augment = self._augment if split == "train" else None
        return FrameDataset(chosen, self._decoder.cache, augment, self._seed)


def _lack(part: str) -> UserError:
    """Return the error of a split that leaves no frames to a part."""
    example = "'data.split={train: 0.8, val: 0.1, test: 0.1}'"
    return UserError(f"data.split: no frames for {part}; give it a share, such as {example}")
