"""The real size of a run's result."""

from dataclasses import replace

from pimper_torch.cli.options import Job
from pimper_torch.io.decode import read_header
from pimper_torch.io.photographs import image_name, list_images
from pimper_torch.records import Reconstruction, Views
from pimper_torch.size.find_scale import find_scale
from pimper_torch.size.given import Mark, Pointer, ScaleBar, number_of, require_inside
from pimper_torch.size.scale import Scale
from pimper_torch.size.scaled import scaled


def in_files(job: Job, views: Views, mark: Mark) -> Mark:
    """Return a place with the sizes of the files, whose pixels it is in.

    People click in files, which viewers turn as EXIF says; ``--max-size-px`` shrinks them later.

    Raises:
        InputError: A pixel outside of its photograph.
    """
    paths = {image_name(path, job.photos): path for path in list_images(job.photos)}

    def sized_pointer(pointer: Pointer) -> Pointer:
        name = views.names[number_of(pointer.name, views.names)]
        header = read_header(paths[name])
        require_inside(pointer, header.width, header.height)
        return replace(pointer, size_px=(header.width, header.height))

    return Mark(pointers=tuple(map(sized_pointer, mark.pointers)))


def bars_in_files(job: Job, views: Views) -> tuple[ScaleBar, ...]:
    """Return scale bars as :func:`in_files`."""
    return tuple(
        replace(bar, first=in_files(job, views, bar.first), second=in_files(job, views, bar.second))
        for bar in job.inputs.scale_bar
    )


def sized(
    job: Job, bars: tuple[ScaleBar, ...], result: Reconstruction
) -> tuple[Reconstruction, Scale | None]:
    """Scale a result to its real size, as far as anything tells it.

    Raises:
        InputError: A length cannot be found in the result.
    """
    inputs = job.inputs
    scale = find_scale(
        result,
        bars=bars,
        camera_distances=inputs.camera_distance,
        markers=inputs.markers,
        unit=inputs.unit,
        own_frame=inputs.sparse is not None,
    )
    return (result, None) if scale is None else (scaled(result, scale.factor), scale)


def told_size(scale: Scale) -> str:
    """State in a sentence what the size was taken from."""
    if scale.count == 1:
        return f"Lengths are in {scale.unit}, by one {scale.source.removesuffix('s')}."
    return (
        f"Lengths are in {scale.unit}, by {scale.count} {scale.source}, which agree to "
        f"{scale.residual:.2%}."
    )
