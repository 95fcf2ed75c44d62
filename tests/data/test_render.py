"""The renderers against geometry: depth on spheres, boxes and oblique planes to 0.1 mm, with
half-pixel canaries.
"""

import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from posefilter.errors import UserError
from posefilter.meshes.mesh import Mesh, creased_normals
from posefilter.rendering.embree import EmbreeRenderer, render_depth
from posefilter.rendering.sampling import sample_texture
from posefilter.rendering.surfaces import Instance, Lights, Plane, Surfaces, pixel_rays, shade
from posefilter.synthetic.lookalikes import box, stretch

H, W = 120, 160
K = np.array([[270.0, 0, 81.3], [0, 268.0, 58.6], [0, 0, 1]])
TOLERANCE = 1e-4  # [m]


def plain(
    name: str, vertices: np.ndarray, faces: np.ndarray, color: tuple[int, int, int] = (200, 100, 50)
) -> Mesh:
    texture = np.array(color, np.uint8).reshape(1, 1, 3)
    return Mesh(name, vertices, faces, None, texture, None, creased_normals(vertices, faces))


def sphere(radius: float) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return plain("sphere", np.asarray(ball.vertices), np.asarray(ball.faces))


def quad(half: float) -> Mesh:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * half
    return plain("quad", corners, np.array([[0, 1, 2], [0, 2, 3]]))


def pose(rotvec: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), translation
    return out


def rays_of(K: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[:H, :W]
    return np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones((H, W))], -1)


def exact_sphere(K: np.ndarray, T: np.ndarray, radius: float) -> np.ndarray:
    d = rays_of(K)
    a, b, c = (d * d).sum(-1), d @ T[:3, 3], T[:3, 3] @ T[:3, 3] - radius**2
    root = b * b - a * c
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)


def exact_box(K: np.ndarray, T: np.ndarray, sides: np.ndarray) -> np.ndarray:
    d, o = rays_of(K) @ T[:3, :3], -T[:3, 3] @ T[:3, :3]
    with np.errstate(divide="ignore"):
        a, b = (-sides / 2 - o) / d, (sides / 2 - o) / d
    enter, leave = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
    return np.where(enter < leave, enter, 0)


def exact_plane(K: np.ndarray, T: np.ndarray) -> np.ndarray:
    return (T[:3, 2] @ T[:3, 3]) / (rays_of(K) @ T[:3, 2])


SPHERE, BOX, PLANE = (
    pose((0, 0, 0), (0.03, -0.02, 0.9)),
    pose((0.5, 0.7, 0.2), (-0.02, 0.03, 0.8)),
    pose((0.9, 0.3, 0), (0, 0, 1.0)),
)
SIDES = np.array([0.16, 0.21, 0.07])
CASES: dict[str, tuple[Mesh, np.ndarray, Callable[[np.ndarray], np.ndarray]]] = {
    "sphere": (sphere(0.12), SPHERE, lambda K: exact_sphere(K, SPHERE, 0.12)),
    "box": (
        box("box", SIDES, [np.zeros((4, 4, 3), np.uint8)] * 6),
        BOX,
        lambda K: exact_box(K, BOX, SIDES),
    ),
    "plane": (quad(5.0), PLANE, lambda K: exact_plane(K, PLANE)),
}


def depth_by_gl(mesh: Mesh, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pytest.importorskip("moderngl", reason="the optional extra [moderngl] is not installed")
    from posefilter.rendering.opengl import GLRenderer

    try:
        seen = GLRenderer().surfaces([Instance(mesh, T)], K, H, W)
    except UserError as error:
        pytest.skip(str(error))
    return seen.depth, seen.index


def depth_by_embree(mesh: Mesh, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return render_depth([mesh], [T], K, H, W)


def judge(depth: np.ndarray, exact: np.ndarray) -> tuple[float, int]:
    """Largest depth error [m] away from the outline, and pixels whose hit or miss differs."""
    both = (depth > 0) & (exact > 0)
    grazing = np.zeros_like(both)
    # the outline's own pixels may fall either way, and grazed spheres are faceted
    for axis in (0, 1):
        for shift in (-4, -2, -1, 1, 2, 4):
            grazing |= np.roll(exact, shift, axis) == 0
    return float(np.abs(depth - exact)[both & ~grazing].max()), int(
        ((depth > 0) != (exact > 0)).sum()
    )


@pytest.mark.parametrize("render", [depth_by_embree, depth_by_gl])
@pytest.mark.parametrize("case", CASES)
def test_depth_agrees_with_geometry_and_half_a_pixel_would_not(render: Callable, case: str) -> None:
    mesh, T, exact = CASES[case]
    depth, index = render(mesh, T)
    error, misfits = judge(depth, exact(K))
    assert error < TOLERANCE
    assert misfits <= 4
    assert ((index == 0) == (depth > 0)).all()
    assert (index == 0).sum() > 1000
    # the canary: the classic silent slip must fail
    for shift in ((0.5, 0), (0, 0.5), (-0.5, 0), (0, -0.5)):
        moved = K.copy()
        moved[:2, 2] += shift
        slipped, misplaced = judge(depth, exact(moved))
        assert slipped > 2 * TOLERANCE or misplaced > 30
    wrong = [
        judge(depth, exact(K + np.array([[0, 0, a], [0, 0, b], [0, 0, 0]])))[0]
        for a, b in ((0.5, 0), (0, 0.5))
    ]
    assert max(wrong) > 2 * TOLERANCE


def test_the_nearer_of_two_is_seen_and_each_is_counted_alone() -> None:
    ball, wall = CASES["sphere"][0], quad(0.4)
    near, far = pose((0, 0, 0), (0, 0, 0.7)), pose((0, 0, 0), (0, 0, 1.0))
    for order in ((0, 1), (1, 0)):
        instances = [(Instance(ball, near), Instance(wall, far))[i] for i in order]
        seen = EmbreeRenderer().surfaces(instances, K, H, W)
        front = order.index(0)
        assert seen.index[58, 81] == front
        assert seen.depth[58, 81] == pytest.approx(0.58, abs=1e-4)
        assert (seen.index == front).sum() == seen.unoccluded[front]
        assert (seen.index == 1 - front).sum() == seen.unoccluded[1 - front] - seen.unoccluded[
            front
        ]


def test_an_object_across_the_near_plane_is_not_lost() -> None:
    depth, index = render_depth([quad(5.0)], [pose((1.45, 0, 0), (0, 0.05, 0.3))], K, H, W)
    exact = exact_plane(K, pose((1.45, 0, 0), (0, 0.05, 0.3)))
    shown = (index == 0) & (exact > 0)
    assert shown.mean() > 0.2
    assert np.abs(depth - exact)[shown & (exact < 2)].max() < TOLERANCE


def test_a_stretched_pose_equals_a_stretched_mesh() -> None:
    mesh, T = CASES["box"][0], CASES["box"][1]
    factors = np.array([1.3, 0.7, 1.1])
    seen = EmbreeRenderer().surfaces([Instance(mesh, T @ np.diag([*factors, 1]))], K, H, W)
    baked = EmbreeRenderer().surfaces(
        [Instance(stretch(mesh, "other", factors, mesh.texture), T)], K, H, W
    )
    np.testing.assert_allclose(seen.depth, baked.depth, atol=2e-6)
    np.testing.assert_allclose(seen.normal, baked.normal, atol=1e-4)


def test_each_face_of_a_box_shows_its_own_print_the_right_way_up() -> None:
    prints = [np.full((8, 8, 3), 20 + 35 * k, np.uint8) for k in range(6)]
    prints[5] = prints[5].copy()
    # the left half of the print on the -z face, which faces an unturned camera
    prints[5][:, :4] = 255
    mesh = box("box", np.array([0.2, 0.2, 0.2]), prints)
    normals = {0: (1, 0, 0), 1: (-1, 0, 0), 2: (0, 1, 0), 3: (0, -1, 0), 4: (0, 0, 1)}
    for k, normal in normals.items():
        turn, _ = Rotation.align_vectors([[0, 0, -1.0]], [normal])
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = turn.as_matrix(), (0, 0, 1)
        seen = EmbreeRenderer().surfaces([Instance(mesh, T)], K, H, W)
        np.testing.assert_allclose(seen.albedo[58, 81], (20 + 35 * k) / 255, atol=1e-3)
        np.testing.assert_allclose(seen.normal[58, 81], (0, 0, -1), atol=1e-5)
    seen = EmbreeRenderer().surfaces([Instance(mesh, pose((0, 0, 0), (0, 0, 1)))], K, H, W)
    # u runs along +x of the object there
    assert seen.albedo[58, 71].mean() == pytest.approx(1, abs=1e-3)
    assert seen.albedo[58, 91].mean() == pytest.approx((20 + 35 * 5) / 255, abs=1e-3)


def test_textures_are_read_bottom_left_first_and_repeat() -> None:
    texture = np.zeros((4, 4, 3), np.uint8)
    texture[3, 0] = 255  # bottom left
    u, v = np.array([0.125, 1.125, 0.125, 0.875]), np.array([0.125, -0.875, 0.875, 0.125])
    np.testing.assert_allclose(sample_texture(texture, u, v)[:, 0], [1, 1, 0, 0], atol=1e-6)


def test_light_follows_lambert_and_shadow_takes_only_its_lamp() -> None:
    normal = np.zeros((1, 2, 3), np.float32)
    normal[...] = (0, 0, -1)
    seen = Surfaces(
        np.ones((1, 2, 3), np.float32),
        normal,
        np.ones((1, 2), np.float32),
        np.zeros((1, 2), np.int32),
        np.array([2]),
    )
    lights = Lights(ambient=0.2, directions=((0, 0, -2), (0, 3**0.5, -1)), strengths=(0.5, 0.4))
    rgb = shade(seen, pixel_rays(np.eye(3), 1, 2), lights, np.array([[1.0, 0.0]], np.float32))
    np.testing.assert_allclose(rgb[0, :, 0], [0.2 + 0.5 + 0.4 * 0.5, 0.2 + 0.4 * 0.5], rtol=1e-5)


def test_a_shadow_falls_where_the_lamp_throws_it() -> None:
    lights = Lights(
        ambient=0.1, directions=((1.0, 0, -1.0),), strengths=(0.5,), shadows=True, shadow_blur=0.4
    )
    floor = Plane(pose((0, 0, 0), (0, 0, 1.0)), (2, 2), np.full((4, 4, 3), 255, np.uint8), 1.0)
    ball = Instance(sphere(0.03), pose((0, 0, 0), (0.0, 0, 0.8)))
    picture = EmbreeRenderer().render([ball], K, H, W, lights, [floor])
    # lamp from the right: the shadow of a ball at z = 0.8 lies 0.2 m to the left on the floor at z
    # = 1
    column, row = round(-0.2 * K[0, 0] + K[0, 2]), round(K[1, 2])
    assert picture.rgb[row, column, 0] == pytest.approx(0.1, abs=0.01)
    assert picture.rgb[row, round(0.2 * K[0, 0] + K[0, 2]), 0] == pytest.approx(
        0.1 + 0.5 / 2**0.5, abs=0.01
    )


def test_both_renderers_agree_on_color_and_index() -> None:
    pytest.importorskip("moderngl", reason="the optional extra [moderngl] is not installed")
    from posefilter.rendering.opengl import GLRenderer

    rng = np.random.default_rng(0)
    prints = [
        np.kron(rng.integers(0, 255, (4, 4, 3)), np.ones((16, 16, 1))).astype(np.uint8)
        for _ in range(6)
    ]
    instances = [
        Instance(box("box", SIDES, prints), BOX),
        Instance(sphere(0.08), pose((0, 0, 0), (0.1, 0.05, 0.7))),
    ]
    plane = Plane(
        pose((0.4, 0.2, 0), (0, 0, 1.1)),
        (0.4, 0.3),
        np.kron(prints[0], np.ones((2, 2, 1))).astype(np.uint8),
        0.3,
    )
    try:
        a = GLRenderer().surfaces(instances, K, H, W, [plane])
    except UserError as error:
        pytest.skip(str(error))
    b = EmbreeRenderer().surfaces(instances, K, H, W, [plane])
    assert (a.index != b.index).mean() < 2e-3
    assert np.abs(a.unoccluded - b.unoccluded).max() <= 12
    same = (a.index == b.index) & (a.depth > 0) & (b.depth > 0)
    assert np.median(np.abs(a.albedo - b.albedo)[same]) < 0.01
    assert np.percentile(np.abs(a.normal - b.normal)[same], 99) < 0.01
    assert np.percentile(np.abs(a.depth - b.depth)[same], 99) < TOLERANCE


def test_without_embree_rendering_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on ARM, where it has no package."""
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(UserError, match="rendering: the package embreex is missing"):
        EmbreeRenderer().depth([Instance(quad(0.1), np.eye(4))], K, H, W)


def test_what_renders_nothing_needs_no_embree() -> None:
    code = (
        "import sys; sys.modules['embreex'] = None; "
        "import posefilter.api, posefilter.cli.convert_bag, posefilter.cli.predict, "
        "posefilter.cli.track"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("seed", range(12))
def test_a_long_object_near_the_camera_is_seen_whole(seed: int) -> None:
    """Where its corners lie far outside of the image."""
    draw = np.random.default_rng(seed)
    sides = np.array([1.2, 0.03, 0.03])
    whole = trimesh.creation.box(sides)
    stick = plain("stick", np.asarray(whole.vertices), np.asarray(whole.faces))
    T = np.eye(4)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * sides / 2
    while True:
        T[:3, :3] = Rotation.random(random_state=draw).as_matrix()
        T[:3, 3] = [*draw.uniform(-0.05, 0.05, 2), draw.uniform(0.1, 0.4)]
        near = (corners @ T[:3, :3].T + T[:3, 3])[:, 2].min()
        exact = exact_box(K, T, sides)
        if 0.03 < near < 0.1 and (exact > 0).mean() > 0.05:
            break
    depth, _ = render_depth([stick], [T], K, H, W)
    assert (depth > 0).mean() == pytest.approx((exact > 0).mean(), abs=0.01)
