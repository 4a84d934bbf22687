"""Priors whose meaning is decided, and agrees with the scene."""

from pimper_torch.method.sfm.undistort import with_undistorted_priors
from pimper_torch.priors.depth import settled_depth
from pimper_torch.priors.normals import settled_normals
from pimper_torch.records import DepthPrior, NormalPrior, Prior, Silhouettes, SparseScene


def settled(scene: SparseScene, silhouettes: Silhouettes | None = None) -> SparseScene:
    """Decide what normals and depth in ``views.priors`` mean, by cloud, cameras and silhouettes.

    Priors of the original photographs are undistorted before. What was left open is found, and
    told in a warning; what contradicts the scene by far is refused by name. Where the scene tells
    nothing, what is stated is believed.

    Returns:
        Normals in our axes of the camera, or in the world; depth along its axis in scene units.
        Differentiable in what priors hold.

    Raises:
        InputError: Names what contradicts, or what has to be stated.
    """
    if not scene.views.priors:
        return scene
    scene = with_undistorted_priors(scene)
    priors: list[Prior] = []
    for prior in scene.views.priors:
        there = [index for index, name in enumerate(prior.names) if name in scene.views.names]
        if there and isinstance(prior, NormalPrior):
            priors.append(settled_normals(prior.take(there), scene, silhouettes))
        elif there and isinstance(prior, DepthPrior):
            priors.append(settled_depth(prior.take(there), scene))
        else:
            priors.append(prior)
    return scene.replace(views=scene.views.replace(priors=tuple(priors)))
