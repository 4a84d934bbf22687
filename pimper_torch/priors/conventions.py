"""Priors with resolved conventions that agree with the scene."""

from pimper_torch.priors.depth import resolve_depth_conventions
from pimper_torch.priors.normals import resolve_normal_conventions
from pimper_torch.priors.undistort import with_undistorted_priors
from pimper_torch.records import DepthPrior, NormalPrior, Prior, Silhouettes, SparseScene
from pimper_torch.runtime.torch_settings import isolated


@isolated
def resolve_prior_conventions(
    scene: SparseScene, silhouettes: Silhouettes | None = None
) -> SparseScene:
    """Resolve conventions of normals and depth in ``views.priors`` by cloud, cameras, silhouettes.

    Priors of the original photographs are undistorted first. Conventions that are not stated are
    determined, with a warning that states them. A stated convention is an error if the scene
    clearly contradicts it, and is used if the scene does not decide.

    Returns:
        The scene with normals in our camera axes or in the world, and depth along the camera's axis
        in scene units. Differentiable in the values of priors.

    Raises:
        InputError: Names the contradiction, or the convention that must be stated.
    """
    if not scene.views.priors:
        return scene
    scene = with_undistorted_priors(scene)
    priors: list[Prior] = []
    for prior in scene.views.priors:
        in_scene = [index for index, name in enumerate(prior.names) if name in scene.views.names]
        if in_scene and isinstance(prior, NormalPrior):
            priors.append(resolve_normal_conventions(prior.take(in_scene), scene, silhouettes))
        elif in_scene and isinstance(prior, DepthPrior):
            priors.append(resolve_depth_conventions(prior.take(in_scene), scene))
        else:
            priors.append(prior)
    return scene.replace(views=scene.views.replace(priors=tuple(priors)))
