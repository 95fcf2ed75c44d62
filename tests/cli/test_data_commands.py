"""Commands about data: what is typed replaces, one scene is enough, problems end with a status."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from tests.data.dataset_trees import bop_scene, pose, write_mesh

from posefilter.cli.build import build_data
from posefilter.cli.check_data import check_data
from posefilter.cli.command import FAILURE, compose_job, run_command
from posefilter.cli.console import setting
from posefilter.cli.evaluate import check_own_folders, data_settings
from posefilter.cli.generate import generate
from posefilter.cli.plain import to_plain
from posefilter.cli.train import places
from posefilter.data.frames import Sample
from posefilter.errors import ProblemsFound, Stopped, UserError
from posefilter.figures.preview import draw_frame

HOME = Path(__file__).parents[2]
CONF = HOME / "conf"
DEFAULTS = {"train": 0.8, "val": 0.1, "test": 0.1}


@pytest.mark.parametrize(
    ("command", "overrides", "split"),
    [
        ("train", [], DEFAULTS),
        ("train", ["data.split={test: 1.0}"], {"test": 1.0}),
        ("evaluate", ["data=ycb_video", "++data.split={test: 1.0}"], {"test": 1.0}),
        ("train", ["data.split.test=0.05"], {**DEFAULTS, "test": 0.05}),
        ("train", ["data.split={train: 0.5}", "data.split.val=0.5"], {"train": 0.5, "val": 0.5}),
        (
            "train",
            ["experiment=memorize", "data.split={train: 0.9, val: 0.1}"],
            {"train": 0.9, "val": 0.1},
        ),
        (
            "train",
            ["data.split={test: keyframe.txt, train: 0.9, val: 0.1}"],
            {"test": "keyframe.txt", "train": 0.9, "val": 0.1},
        ),
    ],
)
def test_a_split_that_is_typed_replaces(
    tmp_path: Path, command: str, overrides: list[str], split: dict[str, object]
) -> None:
    job = compose_job(command, CONF, overrides, tmp_path)
    assert job.cfg.data.split == split


@pytest.mark.parametrize("command", ["evaluate", "calibrate"])
def test_a_split_that_is_typed_replaces_the_checkpoints(tmp_path: Path, command: str) -> None:
    root = f"data.root={tmp_path / 'scenes'}"
    trained = compose_job("train", CONF, [root], tmp_path).cfg
    own = {"data": {**OmegaConf.to_container(trained.data, resolve=True), "augment": {}}}
    job = compose_job(command, CONF, [f"++{root}", "++data.split={val: 1.0}"], tmp_path)
    assert data_settings(job, own, None).split == {"val": 1.0}
    job = compose_job(command, CONF, [f"++{root}", "++data.split.val=0.2"], tmp_path)
    assert data_settings(job, own, None).split == {**DEFAULTS, "val": 0.2}


@pytest.mark.parametrize("key", ["root", "meshes"])
@pytest.mark.parametrize("folder", ["outputs/data/can", "data/can"])
def test_a_checkpoints_own_folder_is_told_to_be_relative(
    key: str, folder: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Typed in another working folder than the training, a command finds no dataset there."""
    (tmp_path / "scenes").mkdir()
    typed = ["data.root=scenes", "data.meshes=scenes"]
    data = compose_job("train", CONF, [*typed, f"data.{key}={folder}"], tmp_path).cfg.data
    own = {"data": {**OmegaConf.to_container(data, resolve=True), "augment": {}}}
    monkeypatch.chdir(tmp_path)

    def settle(*overrides: str) -> None:
        job = compose_job("evaluate", CONF, [*overrides], tmp_path)
        check_own_folders(data_settings(job, own, "carton"), job)

    told = rf"^data\.{key}={folder}: no such folder here; .* relative to where it was trained"
    with pytest.raises(UserError, match=told):
        settle()
    settle(f"++data.{key}=scenes")
    settle("data=scenes", "data.root=elsewhere")
    if key == "root" and folder.startswith("outputs"):  # new scenes are asked for
        settle("++data.generate.frames=5")
    (tmp_path / folder).mkdir(parents=True)
    settle()


def test_a_seed_alone_is_no_split(tmp_path: Path) -> None:
    """Every frame of another folder is tested with it, too, and not a tenth of its scenes."""
    root = f"data.root={tmp_path / 'scenes'}"
    began = [root, "data.split={train: 0.6, val: 0.2, test: 0.2}", "data.split_seed=5"]
    trained = compose_job("train", CONF, began, tmp_path).cfg
    own = {"data": {**OmegaConf.to_container(trained.data, resolve=True), "augment": {}}}

    def settle(recipe: dict[str, object], *typed: str) -> tuple[object, int]:
        job = compose_job("evaluate", CONF, ["data=scenes", *typed], tmp_path)
        found = data_settings(job, recipe, "carton")
        return found.split, found.split_seed

    other = f"data.root={tmp_path / 'other'}"
    assert settle(own, other) == ({"test": 1.0}, 5)
    assert settle(own, other, "data.split_seed=7") == ({"test": 1.0}, 7)
    assert settle({}, other, "data.split_seed=7") == ({"test": 1.0}, 7)
    shares = {"train": 0.6, "val": 0.2, "test": 0.2}
    assert settle(own, root) == (shares, 5)
    assert settle(own, root, "data.split_seed=7") == (shares, 7)
    # the same shares of another seed would be scenes that were learned from
    assert settle(own, root, "data.split={train: 0.6, val: 0.2, test: 0.2}") == (shares, 5)


def test_a_split_that_is_no_mapping_is_refused_in_words(tmp_path: Path) -> None:
    asked = ["data=fat", f"data.root={tmp_path}", "data.split=half"]
    with pytest.raises(
        UserError, match=r"data\.split='half': must be a mapping such as .* or null"
    ):
        build_data(compose_job("train", CONF, asked, tmp_path).cfg.data, "json")


def test_options_of_a_reader_that_are_no_mapping_are_refused_in_words(tmp_path: Path) -> None:
    (tmp_path / "x").touch()
    typed = ["data=bop", f"data.root={tmp_path}", "data.object=obj_000001"]
    own = to_plain(compose_job("train", CONF, typed, tmp_path).cfg)
    job = compose_job("evaluate", CONF, [*typed, "data.options=3"], tmp_path)
    with pytest.raises(UserError, match=r"data\.options=3: must be a mapping"):
        build_data(data_settings(job, own, "obj_000001"), "json")


@pytest.mark.parametrize("chosen", [["data=bop"], []])
@pytest.mark.parametrize(("split", "held_out"), [("train_pbr", True), ("test", False)])
def test_of_another_of_bops_splits_every_frame_is_tested(
    tmp_path: Path, chosen: list[str], split: str, held_out: bool
) -> None:
    root = f"data.root={tmp_path}"
    typed = ["data=bop", root, "data.options.split=train_pbr", "data.object=obj_000001"]
    trained = compose_job("train", CONF, typed, tmp_path).cfg
    own = {"data": {**OmegaConf.to_container(trained.data, resolve=True), "augment": {}}}
    asked = [*chosen, f"++{root}", f"++data.options.split={split}"]
    job = compose_job("evaluate", CONF, asked, tmp_path)
    assert data_settings(job, own, "obj_000001").split == (DEFAULTS if held_out else {"test": 1.0})


def test_the_next_commands_of_few_frames_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    out = tmp_path / "ten"
    size = ["size=[96,72]", "workers=1", "console=json", "seed=4"]
    one = ["frames=10", "frames_per_scene=10"]
    generate(compose_job("generate", CONF, [f"out={out}", *one, *size], tmp_path))
    (following,) = json.loads(capsys.readouterr().out)["next"]
    words = shlex.split(following)
    assert words[:2] == ["python", "check_data.py"]
    arguments = [*words[2:], "console=json"]
    check_data(compose_job("check_data", CONF, arguments, tmp_path / "check"))
    (following,) = json.loads(capsys.readouterr().out)["next"]
    words = shlex.split(following)
    assert words[:2] == ["python", "train.py"]
    data = build_data(compose_job("train", CONF, words[2:], tmp_path).cfg.data, "json")
    data.setup()
    assert [len(data.records(name)) for name in ("train", "val", "test")] == [8, 1, 1]
    assert "scores will flatter" in caplog.text


def test_the_next_command_reads_the_data_as_the_check_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the reader's options it would not find the split, or learn inverted poses."""
    truth, other = pose(), np.linalg.inv(pose())
    inverse = {"obj_id": 2, "cam_R_m2c": other[:3, :3].ravel().tolist()}
    inverse["cam_t_m2c"] = (1000 * other[:3, 3]).tolist()
    for scene in range(3):
        folder = tmp_path / "bop" / "train_own" / f"{scene:06d}"
        bop_scene(folder, [[(2, truth)]])
        (folder / "scene_gt.json").write_text(json.dumps({"0": [inverse]}))
    mesh = write_mesh(tmp_path / "meshes", "toy") / "toy" / "google_16k" / "textured.obj"
    mesh.rename(tmp_path / "meshes" / "obj_000002.obj")
    typed = ["data=bop", f"data.root={tmp_path / 'bop'}", "data.options.split=train_own"]
    typed += ["data.options.inverted=true", f"meshes={tmp_path / 'meshes'}", "mesh_scale=1"]
    check_data(compose_job("check_data", CONF, [*typed, "console=json"], tmp_path / "check"))
    (following,) = json.loads(capsys.readouterr().out)["next"]
    words = shlex.split(following)
    assert words[:2] == ["python", "train.py"]
    data = build_data(compose_job("train", CONF, words[2:], tmp_path).cfg.data, "json")
    data.setup()
    np.testing.assert_allclose(data.train_dataset.sample(0).camera_from_object, truth, atol=1e-6)


def test_an_evaluation_is_told_what_no_checkpoint_decides(tmp_path: Path) -> None:
    """Lists of frames elsewhere, and that frames are kept on disk; it would be refused."""
    (tmp_path / "data").mkdir()
    typed = ["data=ycb_video", f"data.root={tmp_path / 'data'}", "data.cache=disk"]
    typed += [f"data.options.frames={tmp_path / 'own.txt'}"]
    typed += [f"data.split={{test: {tmp_path / 'held.txt'}, train: 0.9, val: 0.1}}"]
    job = compose_job("train", CONF, typed, tmp_path)
    trained = {"data": {**to_plain(job.cfg.data), "augment": {}}, "seed": 0}
    words = [setting(key.replace("__", "."), value) for key, value in places(job).items()]
    assert len(words) == 4
    given = [f"++{shlex.split(word)[0]}" for word in words]
    told = data_settings(compose_job("evaluate", CONF, given, tmp_path), trained, None)
    assert told.options.frames == str(tmp_path / "own.txt")
    assert told.split == {"train": 0.9, "val": 0.1, "test": str(tmp_path / "held.txt")}
    for left_out in given:
        rest = [word for word in given if word != left_out]
        with pytest.raises(UserError, match=r"data\.(root|cache|options\.frames|split\.test)="):
            data_settings(compose_job("evaluate", CONF, rest, tmp_path), trained, None)


@pytest.mark.parametrize(
    ("stop", "told"), [(KeyboardInterrupt(), "interrupted"), (Stopped(15), "stopped by SIGTERM")]
)
def test_a_rendering_that_was_interrupted_says_how_it_goes_on(
    stop: BaseException,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def interrupt(*_: object) -> None:
        raise stop

    monkeypatch.setattr("posefilter.cli.generate.instantiate", interrupt)
    assert run_command("generate", HOME, [f"out={tmp_path}", "object=carton"]) > 128
    (said,) = capsys.readouterr().err.splitlines()
    assert said == f"generate: {told}; give the same command again to go on from there"


def test_one_frame_can_be_generated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = ["size=[96,72]", "workers=1", "console=json"]
    generate(compose_job("generate", CONF, [f"out={tmp_path}/one", "frames=1", *size], tmp_path))
    assert (tmp_path / "one" / "preview.png").is_file()
    assert json.loads(capsys.readouterr().out)["frames"] == 1


@pytest.mark.parametrize(
    ("more", "shown"),
    [(["instances=3", "absent_fraction=0.5", "frames=4"], 2), (["stereo=true", "frames=2"], 2)],
)
def test_a_preview_shows_each_frame_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: list[str], shown: int
) -> None:
    """Whatever the number of instances and cameras."""
    titles: list[str] = []

    def draw(instances: list[Sample], name: str, near: float, far: float) -> np.ndarray:
        titles.append(name)
        return draw_frame(instances, name, near, far)

    monkeypatch.setattr("posefilter.figures.preview.draw_frame", draw)
    typed = [f"out={tmp_path}", "size=[96,72]", "workers=1", "console=json", *more]
    generate(compose_job("generate", CONF, typed, tmp_path))
    assert len(titles) == len({title.rpartition(".")[0] for title in titles}) == shown


def test_frames_without_the_object_can_be_generated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As calibrate.py asks for; there is nothing to outline in a preview."""
    typed = ["absent_fraction=1", "frames=2", "size=[96,72]", "workers=1", "console=json"]
    generate(compose_job("generate", CONF, [f"out={tmp_path}/none", *typed], tmp_path))
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 2
    assert "preview" not in told["files"]
    assert not (tmp_path / "none" / "preview.png").exists()


def test_problems_end_with_a_status(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "data"
    size = ["size=[96,72]", "workers=1", "console=json"]
    generate(compose_job("generate", CONF, [f"out={out}", "frames=2", *size], tmp_path))
    folder = out / "mixed" / "scene0000_0"
    content = json.loads((folder / "_camera_settings.json").read_text())
    for camera in content["camera_settings"]:
        camera["intrinsic_settings"]["cx"] += 20
    (folder / "_camera_settings.json").write_text(json.dumps(content))
    asked = ["data=fat", f"data.root={out}", "data.object=carton", "console=json"]
    with pytest.raises(ProblemsFound, match=r"data: 2 problems; see .*data_report\.json"):
        check_data(compose_job("check_data", CONF, asked, tmp_path / "check"))
    monkeypatch.chdir(tmp_path)
    assert run_command("check_data", HOME, [*asked, f"out={tmp_path / 'again'}"]) == FAILURE
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert json.loads((tmp_path / "again" / "data_report.json").read_text())["problems"]


def test_an_evaluation_renders_nothing_unless_asked(tmp_path: Path) -> None:
    typed = ["data=scenes", f"++data.root={tmp_path / 'mistyped'}"]
    job = compose_job("evaluate", CONF, [*typed, "++data.object=carton"], tmp_path)
    with pytest.raises(UserError, match=r"mistyped: no scenes here .* Nothing is rendered"):
        build_data(data_settings(job, {}, None), "json")
    assert not (tmp_path / "mistyped").exists()
    small = ["++data.generate.frames=1", "++data.generate.size=[96,72]"]
    job = compose_job("evaluate", CONF, [*typed, *small, "++data.object=carton"], tmp_path)
    build_data(data_settings(job, {}, None), "json", job.overrides)
    assert (tmp_path / "mistyped" / "mixed").is_dir()


def test_scenes_that_were_rendered_otherwise_than_is_typed_are_refused(tmp_path: Path) -> None:
    root = tmp_path / "scenes"
    small = ["data.generate.frames=1", "data.generate.size=[96,72]", "data.generate.workers=1"]

    def build(*more: str) -> None:
        typed = [f"data.root={root}", "data.progress=false", *more]
        job = compose_job("train", CONF, typed, tmp_path)
        build_data(job.cfg.data, "json", job.overrides)

    build(*small, "data.generate.max_occlusion=0.2")
    build(*small, "data.generate.max_occlusion=0.2", "data.generate.workers=2")
    build()  # what is not typed is the dataset's
    with pytest.raises(UserError) as refused:
        build("data.generate.max_occlusion=0.5", "data.generate.frames=2", "data.generate.seed=0")
    assert str(refused.value).startswith(
        f"data.generate.frames=2, max_occlusion=0.5: the scenes in {root} were rendered with "
    )


def test_a_mesh_scale_reaches_the_meshes(tmp_path: Path) -> None:
    (tmp_path / "box.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n100 0 0\n0 100 0\n0 0 100\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 2\n"
    )
    typed = [f"data.meshes={tmp_path}", "data.object=box", f"data.root={tmp_path}"]
    with pytest.raises(UserError, match=r"data\.mesh_scale=0\.001"):
        build_data(compose_job("train", CONF, typed, tmp_path).cfg.data, "json")
    typed += ["data.mesh_scale=0.001", "data.generate.frames=0"]
    job = compose_job("train", CONF, typed, tmp_path)
    assert job.cfg.data.generate.mesh_scale == 0.001
    with pytest.raises(UserError, match="frames=0"):  # the next thing that is wrong
        build_data(job.cfg.data, "json")
    predicts = compose_job("predict", CONF, ["meshes=x", "mesh_scale=0.001"], tmp_path)
    assert np.isclose(predicts.cfg.mesh_scale, 0.001)
