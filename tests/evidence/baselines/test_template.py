import pytest
import torch
from torch.testing import assert_close

from pimper_torch.errors import ReconstructionError
from pimper_torch.evidence.baselines.template import (
    fit_colours,
    lay_template,
    raster_faces,
    register,
    registered_views,
    surface_of,
)
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.patches.warp import WarpConfig


def test_samples_of_the_template_lie_on_the_mesh(photographed, bumps):
    _, scene, coarse = photographed(bumps)
    mesh = coarse.mesh
    template = lay_template(mesh, scene.cameras, coarse.reference, 1.0)
    points = template.to_world(template.points(template.depth)[template.inside]).double()
    corners = mesh.vertices_world.double()[mesh.faces]
    normals = torch.nn.functional.normalize(
        face_normals(corners.reshape(-1, 3), torch.arange(3 * len(corners)).reshape(-1, 3)), dim=-1
    )
    off = ((points[:, None] - corners[:, 0]) * normals).sum(dim=-1).abs().amin(dim=1)
    assert off.max() < 1e-4 * template.spacing.double() * 10  # float32 rays
    assert template.normals[template.inside][:, 2].max() < 0  # all face the viewer


def test_the_mesh_of_a_raster_faces_the_viewer_and_is_cut_at_cliffs():
    inside = torch.ones(3, 4, dtype=torch.bool)
    inside[0, 0] = False
    depth = torch.zeros(3, 4)
    depth[:, 3] = 5.0
    faces = raster_faces(inside, depth, cliff=1.0)
    assert len(faces) == 2 * 2 * 2 - 1  # two columns of cells, less one corner
    v, u = inside.nonzero().T
    places = torch.stack([u, v, torch.zeros_like(u)], dim=1).float()
    assert (face_normals(places, faces)[:, 2] == -1).all()


def test_rows_of_the_matrix_are_the_radiance_of_one_point_in_all_views(photographed, bumps):
    truth, scene, coarse = photographed(bumps)
    template = lay_template(coarse.mesh, scene.cameras, coarse.reference, 1.0)
    # On the true surface, what is seen is albedo times the view's own shading.
    vertices = template.points(template.depth)
    for _ in range(20):
        world = template.to_world(vertices)
        gap = world[..., 2] - bumps.height_field(world[..., :2].double()).to(world)
        vertices[..., 2] += gap
    template = template.replace(depth=vertices[..., 2])
    world = template.to_world(vertices)[template.inside]
    normals = bumps.normals(world.double()).float()
    matrix = register(template, scene.views, scene.cameras, coarse.mesh, WarpConfig())
    shading = torch.cat([torch.ones(len(normals), 1), normals], dim=1)
    lights = truth.lights_world.float()
    views = registered_views(template, scene.views, scene.cameras, coarse.mesh, WarpConfig())
    albedo = fit_colours(views, lights, shading)
    assert albedo.shape[1] == 3
    expected = albedo.mean(dim=1) * (lights @ shading.T)
    off = (matrix.radiance - expected).abs()[matrix.seen]
    assert matrix.missing_fraction < 0.4
    assert off.median() < 0.01 * matrix.radiance[matrix.seen].median()  # bilinear look-up


def test_what_a_mask_leaves_out_is_missing(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    template = lay_template(coarse.mesh, scene.cameras, coarse.reference, 0.5)
    masks = torch.ones_like(scene.views.images[:, 0]) > 0
    masks[2] = False
    views = scene.views.replace(masks=masks)
    matrix = register(template, views, scene.cameras, coarse.mesh, WarpConfig())
    assert not matrix.seen[2].any()
    assert matrix.seen[3].any()
    assert (matrix.radiance[~matrix.seen] == 0).all()
    with pytest.raises(ReconstructionError, match="none of the 9 views"):
        register(
            template,
            scene.views.replace(masks=masks & False),
            scene.cameras,
            coarse.mesh,
            WarpConfig(),
        )


def test_a_mesh_seen_from_behind_is_refused(photographed, sphere):
    _, scene, coarse = photographed(sphere)
    inside_out = coarse.mesh.replace(faces=coarse.mesh.faces.flip(1), normals_world=None)
    with pytest.raises(ReconstructionError, match="faces outward"):
        lay_template(inside_out, scene.cameras, coarse.reference, 1.0)
    template = lay_template(coarse.mesh, scene.cameras, coarse.reference, 1.0)
    noise = torch.rand(template.depth.shape, generator=torch.Generator().manual_seed(1))
    with pytest.raises(ReconstructionError, match="no three neighbours"):
        surface_of(template, 1e3 * noise, template.normals[template.inside])


def test_the_template_faces_the_reference_camera_as_its_image_does(photographed, bumps):
    _, scene, coarse = photographed(bumps)
    template = lay_template(coarse.mesh, scene.cameras, coarse.reference, 1.0)
    rotation = template.template_from_world[:3, :3]
    assert_close(rotation @ rotation.mT, torch.eye(3), atol=1e-5, rtol=0)
    assert torch.linalg.det(rotation) > 0
    axes = scene.cameras.cam_from_world[coarse.reference, :3, :3]
    assert ((rotation * axes).sum(dim=1) > 0.9).all()
