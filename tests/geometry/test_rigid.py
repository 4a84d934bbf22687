import torch
from scipy.spatial.transform import RigidTransform, Rotation
from torch.testing import assert_close

from pimper_torch.geometry.rigid import invert_rigid, rigid, rotate, transform


def random_rigid(generator, *batch):
    quaternions = torch.randn(*batch, 4, generator=generator, dtype=torch.float64).numpy()
    rotation = torch.from_numpy(Rotation.from_quat(quaternions.reshape(-1, 4)).as_matrix())
    translation = torch.randn(*batch, 3, generator=generator, dtype=torch.float64)
    return rigid(rotation.reshape(*batch, 3, 3), translation)


def test_transformed_points_agree_with_scipy(generator):
    target_from_source = random_rigid(generator, 1)[0]
    points = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    scipy_transform = RigidTransform.from_matrix(target_from_source.numpy())
    assert_close(
        transform(target_from_source, points), torch.from_numpy(scipy_transform.apply(points))
    )
    directions = torch.from_numpy(scipy_transform.rotation.apply(points.numpy()))
    assert_close(rotate(target_from_source, points), directions)


def test_the_inverse_undoes_the_transform_in_every_batch(generator):
    target_from_source = random_rigid(generator, 2, 3)
    source_from_target = invert_rigid(target_from_source)
    assert_close(source_from_target, torch.linalg.inv(target_from_source))
    points = torch.randn(2, 3, 7, 3, generator=generator, dtype=torch.float64)
    assert_close(transform(source_from_target, transform(target_from_source, points)), points)
