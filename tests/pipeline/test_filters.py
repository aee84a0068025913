"""Filters of models on their way into files: rotations turn colours, boxes cut, cleaning says what it takes."""

import json
import math

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.export.base import read_gaussians, write_gaussians
from warpgs.geometry import rotation_matrices
from warpgs.kernels.sh import basis
from warpgs.pipeline.model.edit import (
    box_of,
    disturbing,
    harmonics_rotation,
    inside,
    levelling,
    limit_degree,
    rotate,
    rotation_about,
)
from warpgs.pipeline.run.export import Filters, convert

TURN = rotation_about(np.array([1.0, -2.0, 0.5]), 1.1)


def covariances(g):
    axes = torch.as_tensor(rotation_matrices(torch.nn.functional.normalize(g.quats.double(), dim=1)))
    return axes @ torch.diag_embed((2 * g.log_scales.double()).exp()) @ axes.mT


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_and_shapes_turn_with_the_scene(degree):
    made = cloud(40, degree=degree)
    turned, turn = rotate(made, TURN), torch.from_numpy(TURN)
    d = torch.nn.functional.normalize(torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)), dim=1)
    k = made.sh.shape[1]
    before = torch.einsum("dk,nkc->dnc", basis(d)[:, :k], made.sh.double())
    after = torch.einsum("dk,nkc->dnc", basis(d @ turn.T)[:, :k], turned.sh.double())
    assert torch.allclose(before, after, atol=1e-6)
    assert torch.allclose(covariances(turned), turn @ covariances(made) @ turn.T, rtol=1e-4, atol=1e-9)
    assert torch.allclose(turned.means.double(), made.means.double() @ turn.T, atol=1e-6)


def test_rotations_of_harmonics_are_orthogonal_and_compose():
    first, second = harmonics_rotation(TURN), harmonics_rotation(TURN @ TURN)
    assert torch.allclose(first @ first.T, torch.eye(25, dtype=torch.float64), atol=1e-13)
    assert torch.allclose(first @ first, second, atol=1e-13)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0, 1, 0), (1, 2, 3), (0, -5, 1e-9)])
def test_up_becomes_minus_y(up):
    rotation = levelling(np.array(up, float))
    assert np.allclose(rotation @ (np.array(up) / np.linalg.norm(up)), [0, -1, 0], atol=1e-8)
    assert np.allclose(rotation @ rotation.T, np.eye(3)) and np.linalg.det(rotation) > 0


def test_boxes():
    made = cloud(200)
    plain = inside(made, box_of("-1,-1,3,1,1,5"))
    assert torch.equal(plain, (made.means - torch.tensor([0.0, 0, 4])).abs().amax(1) <= 1)
    assert torch.equal(plain, inside(made, box_of('{"center": [0, 0, 4], "size": [2, 2, 2]}')))
    turned = json.dumps(
        {"center": [0, 0, 4], "size": [2, 1, 4], "rotation": rotation_about(np.array([0, 0, 1.0]), 0.5).tolist()}
    )
    local = (made.means.double() - torch.tensor([0.0, 0, 4])) @ torch.from_numpy(rotation_about(np.array([0, 0, 1.0]), 0.5))
    assert torch.equal(inside(made, box_of(turned)), (local.abs() <= torch.tensor([1.0, 0.5, 2])).all(1))


@pytest.mark.parametrize(
    "text,match",
    [
        ("1,2,3", "takes 6 finite"), ("a", "six numbers"), ("[" * 9000, "six numbers"),
        ('{"size": [1, 1, 1]}', "center takes 3"),
        ("0,0,0,1,1,0", "longer than 0"), ("0,0,0,1,1,NaN", "finite"),
        ('{"center": [0,0,0], "size": [1,1,1], "rotation": [[2,0,0],[0,1,0],[0,0,1]]}', "must be a rotation matrix"),
    ],
)  # fmt: skip
def test_boxes_that_are_none(text, match):
    with pytest.raises(UsageError, match=match):
        box_of(text)


def test_what_disturbs_is_counted_once():
    made = cloud(100)
    made.log_scales[:] = -5
    made.log_scales[0] = 4  # larger than the scene, and seen by nobody
    made.log_scales[1] = 4
    made.log_scales[2] = torch.tensor([0.5, -4.0, -5.0])  # a long needle
    made.log_scales[4] = torch.tensor([0.5, 0.5 - math.log(30) - 1e-6, -5.0])  # at the limit that a fit holds, as rounded
    made.log_scales[3] = torch.tensor([-4.0, -9.0, -9.0])  # a short one, which stays
    maxima = torch.ones(100)
    maxima[0] = 0
    found = {reason: where.nonzero()[:, 0].tolist() for reason, where in disturbing(made, maxima).items()}
    assert list(found.values()) == [[0], [1], [2]]
    assert list(disturbing(made)) == ["larger than the scene", "needles over 30 times as long as wide"]


def test_degrees():
    assert limit_degree(cloud(5, degree=3), 1).sh.shape[1] == 4
    with pytest.raises(UsageError, match="degrees 0 to 4"):
        limit_degree(cloud(5), 5)


def test_convert_says_what_it_did(tmp_path):
    made = cloud(100, degree=2)
    made.log_scales[7] = 4
    write_gaussians(tmp_path / "a.ply", made, units="file")
    lines = convert(tmp_path / "a.ply", tmp_path / "b.spz", Filters(sh_degree=1))
    assert any("removed Gaussians: 1 larger than the scene (--no-clean" in line for line in lines)
    assert any("above degree 1 are left out (--sh-degree)" in line for line in lines)
    assert any("SPZ files have y up" in line for line in lines)
    assert "99 Gaussians in" in lines[-1] and read_gaussians(tmp_path / "b.spz").sh.shape == (99, 4, 3)
    lines = convert(tmp_path / "b.spz", tmp_path / "c.ply", Filters(crop="-1,-1,3,1,1,5", rotate="0,0,1,180"))
    assert "SPZ files have y up" in lines[0]
    assert not any("removed" in line for line in lines) and any("rotated by 180.0 degrees" in line for line in lines)
    assert float(read_gaussians(tmp_path / "c.ply").means[:, :2].abs().max()) <= 1
    convert(tmp_path / "a.ply", tmp_path / "d.ply")
    assert (tmp_path / "d.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    assert any(".splat files cannot store them" in line for line in convert(tmp_path / "a.ply", tmp_path / "e.splat"))
    with pytest.raises(DataError, match="no Gaussian is left"):
        convert(tmp_path / "a.ply", tmp_path / "f.glb", Filters(crop="90,90,90,91,91,91"))
    assert not (tmp_path / "f.glb").exists()


def test_boxes_of_files(tmp_path):
    """As the viewer saves them; the box is in the units of the source, whatever the rotation."""
    made, path = cloud(100), tmp_path / "crop.json"
    path.write_text('{"center": [1, 0, 4], "size": [2, 4, 4]}')
    assert box_of(str(path)) == box_of('{"center": [1, 0, 4], "size": [2, 4, 4]}')
    write_gaussians(tmp_path / "a.ply", made, units="file")
    lines = convert(tmp_path / "a.ply", tmp_path / "b.ply", Filters(crop=str(path), rotate="0,0,1,180"))
    assert f"{int((made.means[:, 0] < 0).sum())} Gaussians outside the box" in lines[0]
    assert float(read_gaussians(tmp_path / "b.ply").means[:, 0].max()) <= 0
    for text, match in (
        ("[1, 2]", "expected a JSON object"),
        ('{"center": 1}', "center takes 3"),
        (" " * 70000, "larger than 65,536 bytes"),
    ):
        path.write_text(text)
        with pytest.raises(DataError, match=match):
            box_of(str(path))
    with pytest.raises(DataError, match="cannot be read as a box"):
        box_of(str(tmp_path / "none.json"))


@pytest.mark.parametrize("wish,match", [("level", "cameras of a run"), ("0,0,0,9", "length 0"), ("1,2", "x,y,z,degrees")])
def test_rotations_that_are_none(wish, match, tmp_path):
    write_gaussians(tmp_path / "a.ply", cloud(5), units="file")
    with pytest.raises(UsageError, match=match):
        convert(tmp_path / "a.ply", tmp_path / "b.ply", Filters(rotate=wish))
    assert math.isclose(float(np.trace(rotation_about(np.array([0, 0, 2.0]), math.pi))), -1)


@pytest.mark.parametrize(
    "suffix,flags,count",
    [
        ("spz", [], 99), ("ply", [], 100), ("spz", ["--no-clean"], 100), ("ply", ["--clean"], 99),
        ("glb", ["--crop", "-9,-9,-9,9,9,9"], 99),
    ],
)  # fmt: skip
def test_files_for_strangers_are_cleaned_unless_asked_otherwise(suffix, flags, count, tmp_path):
    made = cloud(100)
    made.log_scales[7] = 4
    write_gaussians(tmp_path / "a.ply", made, units="file")
    words = ["convert", str(tmp_path / "a.ply"), str(tmp_path / f"b.{suffix}")]
    assert main([*words, *flags]) == 0 and len(read_gaussians(tmp_path / f"b.{suffix}")) == count
    assert main([*words, "--clean", "--no-clean"]) == UsageError.exit_code
