import pytest
import torch

from recon.readers.stated import posed, rigid, stating
from scenes.lenses import OpenCV, Pinhole
from scenes.poses import inverse, pose_from, translation, yaw


def some(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(5)
    quats, places = (torch.randn(count, n, generator=generator, dtype=torch.float64) for n in (4, 3))
    return pose_from(quats, places)


@pytest.mark.parametrize("digits", [3, 4, 6])
def test_rounded_rotations_become_the_nearest(digits):
    poses = some(50)
    rounded = torch.round(poses, decimals=digits)
    found = rigid(rounded, "poses.txt")
    off = found[:, :3, :3] @ found[:, :3, :3].mT - torch.eye(3, dtype=torch.float64)
    assert off.abs().max() < 1e-14 and torch.equal(found[:, :3, 3], rounded[:, :3, 3])
    assert (found - poses).abs().max() < 2 * 10.0**-digits
    assert torch.allclose(found @ inverse(found), torch.eye(4, dtype=torch.float64).expand(50, 4, 4), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    "wrong", [torch.diag(torch.tensor([1.0, 1, -1])), 1.1 * torch.eye(3), torch.zeros(3, 3), torch.full((3, 3), torch.nan)]
)
def test_what_is_no_rotation_is_refused_with_its_place(wrong):
    poses = some(4)
    poses[2, :3, :3] = wrong.double()
    with pytest.raises(ValueError, match="^poses.txt: pose 2 is no rotation and place"):
        rigid(poses, "poses.txt")
    with pytest.raises(ValueError, match="^calib.txt, Tr: pose is no rotation"):
        rigid(poses[2], "calib.txt, Tr")


def test_quaternions_without_a_turn_are_refused_with_their_place():
    quats, places = torch.tensor([[2.0, 0, 0, 0], [0, 0, 0, 0]]).double(), torch.zeros(2, 3).double()
    with pytest.raises(ValueError, match="^poses.json: pose 1 is not finite or has no rotation"):
        posed(quats, places, "poses.json")
    assert torch.equal(posed(quats[:1], places[:1], "poses.json")[0], translation())
    with pytest.raises(ValueError, match="pose 0 is not finite"):
        posed(quats, places + torch.nan, "poses.json")


@pytest.mark.parametrize(
    "make", [lambda: Pinhole(-1, 1, 0, 0), lambda: Pinhole(float("nan"), 1, 0, 0), lambda: OpenCV(9, 9, 0, float("inf"))]
)
def test_lenses_that_are_none_are_told_with_their_file(make):
    with pytest.raises(ValueError, match="^cameras.txt, camera 1: [cf][xy] "), stating("cameras.txt, camera 1"):
        make()


def test_turns_stay_turns():
    assert torch.allclose(rigid(yaw(2.0), "x"), yaw(2.0), rtol=0, atol=1e-15)
