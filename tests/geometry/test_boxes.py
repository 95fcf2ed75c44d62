"""Boxes of poses and their overlap, against values worked out by hand."""

import torch

from posefilter.geometry.boxes import box_iou, box_of_pose
from posefilter.geometry.camera import intrinsics
from posefilter.geometry.pose import make_pose

K = intrinsics(100.0, 100.0, 10.0, 5.0)  # of a frame 21 wide and 11 high
POINTS = torch.tensor([[-0.02, -0.01, 0.0], [0.02, 0.01, 0.0]])


def at(x: float, y: float, z: float) -> torch.Tensor:
    return make_pose(torch.eye(3), torch.tensor([x, y, z]))


def box(pose: torch.Tensor, points: torch.Tensor = POINTS) -> list[float]:
    return [round(v, 3) for v in box_of_pose(pose, points, K, 11, 21).tolist()]


def test_the_box_is_that_of_the_projected_points() -> None:
    assert box(at(0, 0, 1)) == [8, 4, 12, 6]
    assert box(at(0.03, 0, 0.5)) == [12, 3, 20, 7]


def test_it_ends_at_the_frames_outer_edges() -> None:
    assert box(at(-0.1, 0, 1)) == [-0.5, 4, 2, 6]
    assert box(at(0.1, 0.05, 1)) == [18, 9, 20.5, 10.5]
    assert box(at(0, 0, 0.01)) == [-0.5, -0.5, 20.5, 10.5]


def test_out_of_the_frame_or_behind_the_camera_there_is_none() -> None:
    for pose in (at(0.2, 0, 1), at(-0.2, 0, 1), at(0, 0.2, 1), at(0, -0.2, 1), at(0, 0, -1)):
        assert box(pose) == [0, 0, 0, 0]
    # one point before the camera is enough
    long = torch.tensor([[0.0, 0.0, -2.0], [0.02, 0.01, 0.0]])
    assert box(at(0, 0, 1), long)[2:] == [12, 6]


def test_each_of_many_poses_has_its_own_box() -> None:
    poses = torch.stack(
        [
            torch.stack([at(0, 0, 1), at(0, 0, -1), at(0.2, 0, 1)]),
            torch.stack([at(0, 0, -1), at(0, 0, -2), at(0.03, 0, 0.5)]),
        ]
    )
    boxes = box_of_pose(poses, POINTS, K.expand(2, 3, 3, 3), 11, 21)
    alone = [[box_of_pose(pose, POINTS, K, 11, 21) for pose in row] for row in poses]
    torch.testing.assert_close(boxes, torch.stack([torch.stack(row) for row in alone]))
    assert (boxes != 0).any(-1).tolist() == [[True, False, False], [False, False, True]]


def test_the_overlap_is_shared_area_over_the_area_of_both() -> None:
    a = torch.tensor([0.0, 0.0, 4.0, 2.0])
    cases = (
        ([0.0, 0.0, 4.0, 2.0], 1.0),
        ([2.0, 0.0, 6.0, 2.0], 4 / 12),
        ([1.0, 1.0, 3.0, 5.0], 2 / 14),
        ([4.0, 0.0, 6.0, 2.0], 0.0),
        ([5.0, 3.0, 6.0, 4.0], 0.0),  # both sides of the overlap would be negative
        ([0.0, 0.0, 0.0, 0.0], 0.0),
    )
    b, want = torch.tensor([c[0] for c in cases]), torch.tensor([c[1] for c in cases])
    torch.testing.assert_close(box_iou(a.expand(6, 4), b), want)
    torch.testing.assert_close(box_iou(b, a.expand(6, 4)), want)
    assert box_iou(torch.zeros(4), torch.zeros(4)) == 0
    tiny = torch.tensor([0.0, 0.0, 0.5, 0.5])
    assert box_iou(tiny, tiny) == 1
