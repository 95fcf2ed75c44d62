"""Packed weights are small, come back close, and leave alone what is not a float."""

import torch
from tests.models.toy import square
from torch import nn

from posefilter.models.quantization import pack, pack_object, unpack, unpack_object


def net() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Conv2d(16, 64, 3),
        nn.BatchNorm2d(64),
        nn.ReLU(),
        nn.Conv2d(64, 64, 3),
        nn.BatchNorm2d(64),
    ).eval()


def size(state: dict[str, torch.Tensor]) -> int:
    return sum(x.numel() * x.element_size() for x in state.values())


def test_weights_come_back_close_and_cost_a_quarter() -> None:
    before = net()
    packed = pack(before.state_dict())
    assert size(packed) < 0.27 * size(before.state_dict())
    after = net()
    nn.init.zeros_(after[0].weight)
    after.load_state_dict(unpack(packed))
    for a, b in zip(before.parameters(), after.parameters(), strict=True):
        assert (a - b).norm() < 0.01 * a.norm() + 1e-6
    x = torch.randn(2, 16, 20, 20)
    assert (before(x) - after(x)).norm() < 0.02 * before(x).norm()


def test_counters_stay_whole_numbers() -> None:
    state = net().state_dict()
    assert unpack(pack(state))["1.num_batches_tracked"].dtype == torch.int64


def test_a_plain_state_passes_unchanged() -> None:
    state = net().state_dict()
    for name, value in unpack(state).items():
        assert torch.equal(value, state[name])


def test_points_far_from_the_origin_come_back_as_well_as_those_about_it() -> None:
    """As of a mesh that was scanned in a room's frame."""
    center, look = torch.tensor([3.0, -5.0, 1.0]), torch.rand(300, 3)
    points = 0.1 * torch.randn(300, 3)
    plain = {
        **square()._asdict(),
        "center": center,
        "points": center + points,
        "texture": torch.cat(
            [center + points, torch.nn.functional.normalize(look, dim=1), look], 1
        ),
    }
    packed = pack_object(plain)
    assert pack_object(packed)["points"].equal(packed["points"])
    after = unpack_object(packed)
    assert after.texture is not None
    for found in (after.points, after.texture[:, :3].float()):
        assert (found - center - points).abs().max() < 2e-4
    again = unpack_object(pack_object(after._asdict()))
    assert (again.points - center - points).abs().max() < 4e-4
    del plain["texture"]  # as a file of an earlier version
    assert (unpack_object(pack_object(plain)).points - center - points).abs().max() < 2e-4


def test_surface_points_come_back_to_a_ten_thousandth_and_the_rest_as_it_was() -> None:
    points = 0.1 * torch.randn(500, 3)
    texture = torch.rand(700, 9)
    texture[:, 3:6] = torch.nn.functional.normalize(torch.randn(700, 3), dim=1)
    plain = {**square()._asdict(), "points": points, "texture": texture}
    packed = pack_object(plain)
    assert packed["points"].dtype == packed["texture"].dtype == torch.float16
    assert pack_object(packed).keys() == packed.keys()
    assert torch.equal(pack_object(packed)["texture"], packed["texture"])
    after = unpack_object(packed)
    assert after.points.dtype == torch.float32
    assert (after.points - points).abs().max() < 5e-4 * points.abs().max()
    assert torch.equal(after.hull, plain["hull"])
    assert after.texture is not None
    error = (after.texture.float() - texture).abs()
    assert error[:, :3].max() < 5e-4
    assert error[:, 3:6].max() < 1 / 127
    assert error[:, 6:].max() < 0.51 / 255 + 3e-4
    again = unpack_object(pack_object(after._asdict()))
    assert again.texture is not None
    assert torch.equal(again.texture[:, 6:], after.texture[:, 6:])
    assert pack_object({**plain, "texture": None})["texture"] is None
