"""Scenes of calibrations are of seeds that neither trainings nor tests have."""

import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from posefilter.cli.choices import check_choices
from posefilter.cli.command import compose_job
from posefilter.paths import find_conf

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))  # scripts import their neighbors
Load = Callable[[str], ModuleType]


def seeds_of(commands: list[list[str]]) -> set[str]:
    return {word for words in commands for word in words if word.startswith("seed=")}


def test_seeds_are_its_own_and_all_else_is_as_for_the_last_training(load_script: Load) -> None:
    own = load_script("bench/calibrations.py").render_commands(Path("r"), 90)
    sets = load_script("bench/photographs.py").list_sets(Path("r"))
    seeds = [seeds_of(each) for each in (own, *sets)]
    assert (
        [len(each) for each in seeds] == [*[len(own)] * 5, 12] == [*[14] * 5, 12]
    )  # few in the last
    assert len(set.union(*seeds)) == 5 * 14 + 12
    fifth, sixth = sets[-2:]
    for one in own:
        (same,) = (other for other in fifth if one[2] in other)
        others = [other for other in sixth if one[2] in other]
        for other in (same, *others):
            differ = {*one} - {*other}
            assert {word.split("=")[0] for word in differ} == {"seed", "progress", "frames", "out"}


def test_what_is_typed_is_as_commands_take_it_now(load_script: Load) -> None:
    calibrations = load_script("bench/calibrations.py")
    photographs = load_script("bench/photographs.py")
    root, conf = Path("r"), find_conf()
    sets = [calibrations.render_commands(root, 90), *photographs.list_sets(root)]
    trainings = [photographs.train_command(run, root) for run in photographs.plan()]
    for words in [*(words for each in sets for words in each), *trainings]:
        check_choices(words[1:], conf, words[0].removesuffix(".py"))
    for each in sets:
        texture = compose_job("generate", conf, each[0][1:], root).cfg.lookalike_texture
        assert texture in ("different", "same")
    for words in trainings[-1:]:
        augment = compose_job("train", conf, words[1:], root).cfg.data.augment
        assert augment.steps[1].object_size_probability == 0.25


def test_each_file_is_calibrated_in_place_after_the_scenes_are_rendered(
    load_script: Load,
) -> None:
    files = [Path("a.ckpt"), Path("b.ckpt")]
    commands = load_script("bench/calibrations.py").list_commands(files, Path("r"), 400, 240, 90)
    assert [words[0] for words in commands] == ["generate.py"] * 14 + ["calibrate.py"] * 2
    for file, words in zip(files, commands[-2:], strict=True):
        assert f"checkpoint={file.resolve()}" in words
        assert {"frames=400", "absent_frames=240", "overwrite=true", "data.split={val: 1.0}"} <= {
            *words
        }
        assert not any(word.startswith("out=") for word in words)
