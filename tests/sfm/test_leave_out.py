import numpy as np
import torch

from pimper_torch.geometry.colmap_library import loaded
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.sfm.static_background import remove_static_features
from tests.sfm.captured import FOCAL, HEIGHT, WIDTH, Captured, orbit, seen_of_ball, turntable

SETTINGS = ReconstructConfig(threads=1)


def stored(scene, path):
    """Write features, matches and verified pairs to a database, images in reversed order."""
    pycolmap = loaded()
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error, options.ransac.random_seed = 2.0, 0
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, WIDTH, HEIGHT)
    with pycolmap.Database.open(path) as database:
        database.write_camera(camera, use_camera_id=True)
        for view in reversed(range(len(scene.keypoints))):
            image = pycolmap.Image(name=f"{view:06d}.png", camera_id=1, image_id=100 - view)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(100 - view, scene.keypoints[view].numpy())
            signs = np.repeat(scene.thing[view].numpy()[:, None] // 4, 128, axis=1)
            kind = pycolmap.FeatureExtractorType.SIFT
            described = pycolmap.FeatureDescriptors(kind, signs.astype(np.uint8))
            database.write_descriptors(100 - view, described)
        for (first, second), matches in scene.pairs.items():
            ids = 100 - first, 100 - second
            rows = matches.numpy().astype(np.uint32)
            database.write_matches(*ids, rows)
            ends = [scene.keypoints[end].double().numpy() for end in (first, second)]
            geometry = pycolmap.estimate_two_view_geometry(
                camera, ends[0], camera, ends[1], rows, options
            )
            database.write_two_view_geometry(*ids, geometry)
    return path


def read(path, scene):
    """Return matches and verified matches of each pair."""
    with loaded().Database.open(path) as database:
        return [
            (
                torch.from_numpy(database.read_matches(*ids).astype(np.int64)),
                torch.from_numpy(geometry.inlier_matches.astype(np.int64)).reshape(-1, 2),
            )
            for first, second in scene.pairs
            for ids in [(100 - first, 100 - second)]
            for geometry in [
                database.read_two_view_geometry(*ids)
                if database.exists_two_view_geometry(*ids)
                else loaded().TwoViewGeometry()
            ]
        ]


def test_pairs_verified_on_the_background_are_verified_on_the_object(tmp_path, generator):
    # Enough static features that every pair is first verified on them.
    scene = turntable(generator, turning=250, resting=300, count=5, span_deg=100.0)
    path = stored(scene, tmp_path / "database.db")
    on_room = 0
    for pair, (_, verified) in zip(scene.pairs, read(path, scene), strict=True):
        on_room += int((scene.thing[pair[0]][verified[:, 0]] >= 250).double().mean() > 0.9)
    assert on_room == len(scene.pairs)
    former = [scene.thing, scene.keypoints]
    rest = remove_static_features(path, SETTINGS)
    assert rest.detected
    assert all(torch.equal(one, torch.eye(3).double()) for one in rest.maps)
    scene.thing, scene.keypoints = (
        [values[~resting] for values, resting in zip(all_of, rest.features, strict=True)]
        for all_of in former
    )
    with loaded().Database.open(path) as database:
        for view, (thing, pixels) in enumerate(zip(scene.thing, scene.keypoints, strict=True)):
            assert (thing >= 250).sum() <= 3
            assert np.array_equal(database.read_keypoints(100 - view)[:, :2], pixels.numpy())
            signs = database.read_descriptors(100 - view).data[:, 0]
            assert np.array_equal(signs, (thing // 4).numpy())
    for pair, (matches, verified) in zip(scene.pairs, read(path, scene), strict=True):
        for rows in (matches, verified):
            detected = scene.thing[pair[0]][rows[:, 0]] >= 250
            assert not (detected & scene.right(pair, rows)).any()
        assert len(verified) >= 15
        assert scene.right(pair, verified).double().mean() > 0.95


def test_a_rigid_scene_keeps_all_its_matches(tmp_path, generator):
    scene = Captured(generator, seen_of_ball(generator, 300, orbit(5, 100.0)))
    path = stored(scene, tmp_path / "database.db")
    before = read(path, scene)
    rest = remove_static_features(path, SETTINGS)
    assert not rest.detected
    assert not rest.maps
    assert not any(resting.any() for resting in rest.features)
    for one, other in zip(before, read(path, scene), strict=True):
        assert torch.equal(one[0], other[0])
        assert torch.equal(one[1], other[1])
