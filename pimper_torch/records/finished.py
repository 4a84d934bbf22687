"""A surface that is ready to be written, and its errors against photographs."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from pimper_torch.records.record import Record
from pimper_torch.records.scene import Mesh
from pimper_torch.records.shapes import FaceMask, Vertices


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ClosedMesh(Record):
    """A mesh with capped borders.

    Attributes:
        mesh: The faces before capping first, in the same order, without those trimmed at borders.
        measured: True for these faces; the others are caps.
        borders: Number of capped borders.
    """

    mesh: Mesh
    measured: FaceMask
    borders: int


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class FinishedMesh(Record):
    """A surface as written to files.

    Attributes:
        mesh: Without caps; images show it.
        few: The same with about 50,000 faces if it has more, for editing and for browsers.
        closed: With caps, if requested.
        how: ``"simplified"``, ``"reduced"`` to a number of faces, or empty if unchanged.
        counts: Numbers of vertices and faces, and how far simplification moved the surface.
        caps: Numbers of capped borders, of faces of the caps and of faces trimmed for them, and the
            caps' fraction of the area.
    """

    mesh: Mesh
    few: Mesh
    closed: ClosedMesh | None
    how: str
    counts: dict[str, int | float]
    caps: dict[str, int | float]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewLights(Record):
    """The light of every view, for base colours as written to files.

    Attributes:
        direction_world: Unit, from the surface's centre towards the light.
        inverse_distance: The surface's radius over the light's distance; 0 for a light at infinity.
        ambient: Radiance of a white matte surface in shadow.
        directed: Added radiance where it faces the light, at the distance of the centre.
    """

    direction_world: Float[Tensor, "view 3"]
    inverse_distance: Float[Tensor, " view"]
    ambient: Float[Tensor, "view channel"]
    directed: Float[Tensor, "view channel"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Materials(Record):
    """Materials of a surface in glTF's terms, one per cluster of albedo.

    Attributes:
        roughness: In [0, 1]; its square is GGX's alpha.
        specular: Factor on the reflectance of glTF's dielectric at normal incidence;
            ``KHR_materials_specular``'s ``specularFactor`` up to 1, ``specularColorFactor`` above.
    """

    cluster: Int[Tensor, " vertex"]
    metallic: Float[Tensor, " cluster"]
    roughness: Float[Tensor, " cluster"]
    specular: Float[Tensor, " cluster"]

    @classmethod
    def of(cls, cluster: Int[Tensor, " vertex"], values: Float[Tensor, "cluster 3"]) -> "Materials":
        """Return materials from metallic, roughness and specular of each cluster."""
        metallic, roughness, specular = values.unbind(dim=1)
        return cls(cluster=cluster, metallic=metallic, roughness=roughness, specular=specular)

    @property
    def values(self) -> Float[Tensor, "cluster 3"]:
        """Metallic, roughness and specular of every cluster."""
        return torch.stack([self.metallic, self.roughness, self.specular], dim=1)

    def at_vertices(self) -> Vertices:
        """Return metallic, roughness and specular of every vertex."""
        return self.values[self.cluster]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewErrors(Record):
    """Errors of a rendered surface in photographs, each under its best-fitting light.

    Attributes:
        psnr_db: Of sRGB values in [0, 1], over the object's pixels.
    """

    psnr_db: Float[Tensor, " view"]
    lights: ViewLights
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Relighting(Record):
    """The lights and materials of a result, and its errors in photographs.

    Attributes:
        lights: Of the photographs from which the surface was made.
        errors: With materials.
        matte: Without materials.
        held_out: True if the errors are in held-out photographs, not in those of the surface.
        textured: With materials, and the asset's textures instead of vertex values.
    """

    lights: ViewLights
    materials: Materials
    errors: ViewErrors
    matte: ViewErrors
    held_out: bool
    textured: ViewErrors | None = None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class TexturedMesh(Record):
    """A mesh with textures, as glTF requires.

    Attributes:
        mesh: Vertices are duplicated along seams.
        vertex: Index of the original vertex of each copy.
        normals: Unit, of every vertex; the normal map is relative to them.
        uv: Right and down over the textures, in [0, 1].
        tangent: Unit along ``u``, and the sign of the bitangent.
        normal: Along tangent, bitangent and normal: 0 is -1, and 255 is 1.
        uncertainty: Of the base colour: 0 where light determines it, 128 where too few lights do,
            and 255 where it is inpainted from neighbours.
        reflectance: Metallic, roughness and specular in [0, 1]; ``None`` for matte.
    """

    mesh: Mesh
    vertex: Int[Tensor, " copy"]
    normals: Float[Tensor, "copy 3"]
    uv: Float[Tensor, "copy 2"]
    tangent: Float[Tensor, "copy 4"]
    base_color: UInt8[Tensor, "height width 3"]
    normal: UInt8[Tensor, "height width 3"]
    uncertainty: UInt8[Tensor, "height width"]
    reflectance: Float[Tensor, "height width 3"] | None
    charts: int

    @property
    def summary(self) -> dict[str, int | float]:
        """Counts and sizes for ``summary.json``."""
        height, width = self.normal.shape[:2]
        faces = len(self.mesh.faces)
        return {"faces": faces, "charts": self.charts, "width_px": width, "height_px": height}


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Verdict(Record):
    """Whether a result can be trusted, by figures of the run.

    Attributes:
        score: In [0, 1]: at least 0.5 for a good result, 0 for one that is not usable.
        text: In one or two sentences, with the reasons and the worst photograph.
        scores: Of each figure; the least one is that of the result.
    """

    score: float
    text: str
    scores: dict[str, float]

    @property
    def good(self) -> bool:
        """Whether no figure is worse than those of good results."""
        return self.score >= 0.5
