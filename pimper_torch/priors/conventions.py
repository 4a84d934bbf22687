"""Priors of a decided meaning, which agrees with the scene."""

from pimper_torch.method.sfm.undistort import with_undistorted_priors
from pimper_torch.priors.depth import resolve_depth_conventions
from pimper_torch.priors.normals import resolve_normal_conventions
from pimper_torch.records import DepthPrior, NormalPrior, Prior, Silhouettes, SparseScene


def resolve_prior_conventions(
    scene: SparseScene, silhouettes: Silhouettes | None = None
) -> SparseScene:
    """Decide the meaning of normals and depth in ``views.priors`` by cloud, cameras, silhouettes.

    Priors of the original photographs are undistorted first. Meanings that were left open are
    found, and a warning states them; a stated meaning that contradicts the scene by far is refused
    by name. It is believed where the scene does not decide.

    Returns:
        Normals in our axes of the camera, or in the world; depth along its axis in scene units.
        Differentiable in the values of priors.

    Raises:
        InputError: Names the contradiction, or the statement that is missing.
    """
    if not scene.views.priors:
        return scene
    scene = with_undistorted_priors(scene)
    priors: list[Prior] = []
    for prior in scene.views.priors:
        there = [index for index, name in enumerate(prior.names) if name in scene.views.names]
        if there and isinstance(prior, NormalPrior):
            priors.append(resolve_normal_conventions(prior.take(there), scene, silhouettes))
        elif there and isinstance(prior, DepthPrior):
            priors.append(resolve_depth_conventions(prior.take(there), scene))
        else:
            priors.append(prior)
    return scene.replace(views=scene.views.replace(priors=tuple(priors)))
