"""Scenes with several instances of the target: rendered, written and read back."""

import json
from pathlib import Path

import numpy as np
import pytest

from posefilter.data.readers.registry import open_reader
from posefilter.errors import UserError
from posefilter.meshes.store import MeshStore
from posefilter.synthetic.generate import generate

FEW = {"object": "carton", "workers": 1, "size": (160, 120), "frames_per_scene": 2}


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return four frames with three cartons each."""
    out = tmp_path_factory.mktemp("copies") / "scenes"
    generate(out, 4, instances=3, distractors=(0, 1), progress=False, **FEW)  # type: ignore[arg-type]
    return out


def test_every_frame_shows_so_many_instances_each_on_pixels_of_its_own(scenes: Path) -> None:
    reader = open_reader("fat", scenes, "carton", MeshStore("builtin"))
    records = reader.records()
    assert len(records) == 12
    for name in {record.name for record in records}:
        own = [i for i, record in enumerate(records) if record.name == name]
        samples = [reader.read(i) for i in own]
        masks = np.stack([sample.mask for sample in samples])
        assert len(own) == 3
        assert int(masks.sum(0).max()) == 1
        places = np.stack([sample.camera_from_object[:3, 3] for sample in samples])
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1)[np.triu_indices(3, 1)]
        assert apart.min() > 0.03
        for sample in samples:  # the least that a frame may show of its target
            assert reader.visible_share(sample) > 0.2


def test_one_instance_is_what_it_was(scenes: Path, tmp_path: Path) -> None:
    """A setting that was not there changes no frame; and folders go on as they were begun."""
    for name, more in (("a", {}), ("b", {"instances": 1})):
        generate(tmp_path / name, 2, progress=False, **FEW, **more)  # type: ignore[arg-type]
    first, second = (sorted((tmp_path / name).rglob("*.jpg")) for name in ("a", "b"))
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]
    record = tmp_path / "a" / "_generator.json"
    content = json.loads(record.read_text())
    del content["settings"]["scenes"]["instances"]  # as an earlier version wrote it
    record.write_text(json.dumps(content))
    assert generate(tmp_path / "a", 2, progress=False, **FEW).rendered == 0  # type: ignore[arg-type]
    with pytest.raises(UserError, match="other settings"):
        generate(scenes, 4, distractors=(0, 1), progress=False, **FEW)  # type: ignore[arg-type]


def test_absent_means_all_of_them(tmp_path: Path) -> None:
    out = tmp_path / "none"
    generate(out, 2, instances=2, absent_fraction=1.0, progress=False, **FEW)  # type: ignore[arg-type]
    files = list(out.glob("mixed/*/[0-9]*.json"))
    assert len(files) == 2
    for file in files:
        classes = {one["class"] for one in json.loads(file.read_text())["objects"]}
        assert "carton_16k" not in classes
