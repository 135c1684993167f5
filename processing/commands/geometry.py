"""`process camera-pose` and `process register`: where the camera and the object are."""

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import CALIBRATION, command
from processing.whole_file import write_whole_text


@command("camera-pose", CALIBRATION)
def camera_pose_command(
    *,
    images: Annotated[list[Path], typer.Argument(help="Images of a ChArUco board, tilted this way and that.")],
    squares: Annotated[str, typer.Option(help="Squares across and down, e.g. 8x6.")],
    square_mm: Annotated[float, typer.Option(help="Side of a square in mm.")],
    marker_mm: Annotated[float, typer.Option(help="Side of a marker in mm.")],
    pixel_mm: Annotated[float, typer.Option(help="Pixel pitch of the sensor in mm, e.g. 0.00345.")],
    out: Annotated[Path, typer.Option(help="Camera file (YAML) to write.")],
    dictionary: Annotated[str, typer.Option(help="Marker dictionary of the board.")] = "DICT_4X4_50",
    at_centre: Annotated[
        Path | None, typer.Option(help="The image whose board stands in the centre of rotation; default: the first.")
    ] = None,
) -> None:
    """Calibrate the camera: focal length, optical axis, distortion, distance."""
    from processing.errors import ProcessError
    from processing.geometry.camera_pose import Board, calibrate, read_grey
    from processing.yaml_file import dump_yaml

    across, cross, down = squares.lower().partition("x")
    if not (cross and across.isdecimal() and down.isdecimal()):
        raise ProcessError(f"--squares {squares!r} is not like 8x6 (squares across and down)")
    board = Board(int(across), int(down), square_mm, marker_mm, dictionary)
    result = calibrate(
        [(str(p), read_grey(p)) for p in images], board, pixel_mm, None if at_centre is None else str(at_centre)
    )
    write_whole_text(out, dump_yaml(result.camera))
    camera = result.camera
    typer.echo(f"  images used: {len(result.used)} of {len(images)}")
    typer.echo(f"  reprojection error: {result.residual_px:.3f} pixels rms")
    typer.echo(f"  focal length: {camera.focal_length_mm:.3f} +- {camera.stderr['focal_length_mm']:.3f} mm")
    typer.echo(f"  optical axis at row, column: {camera.axis_px[0]:.1f}, {camera.axis_px[1]:.1f}")
    typer.echo(f"  distance of the board in the centre: {camera.distance_mm:.2f} mm")
    for name in result.skipped:
        typer.echo(f"warning: no board found in {name}", err=True)
    typer.echo(str(out))


@command("register", CALIBRATION)
def register_command(
    source: Annotated[Path, typer.Argument(help="Product of `process reduce` that shows the object.")],
    geometry: Annotated[Path, typer.Option(help="Geometry file to start from.")],
    out: Annotated[Path, typer.Option(help="Geometry file (YAML) to write.")],
    threshold: Annotated[
        float, typer.Option(min=0, max=1, help="Mesh: part of the brightest intensity that counts as object.")
    ] = 0.05,
) -> None:
    """Find the object in an image: centre and scale of a sphere, pose of a mesh."""
    import numpy as np

    from processing.geometry.mesh import Mesh
    from processing.geometry.outline import find_sphere, register_sphere
    from processing.geometry.pose import refine_pose
    from processing.geometry.viewing import ViewingGeometry
    from processing.storage.products.product import Product
    from processing.yaml_file import dump_yaml

    with Product(source) as product:
        product.require("mueller", "stokes")
        image = product.get("mueller")[0, 0] if product.kind == "mueller" else product.get("s0")
    view = ViewingGeometry.load(geometry)
    rows, columns = image.shape
    if isinstance(view.shape, Mesh):
        camera = view.camera.resized(rows, columns)
        bright = np.nan_to_num(image) > threshold * np.nanpercentile(image, 99.5)
        fit = refine_pose(view.shape, camera, bright)
        view = view.model_copy(update={"camera": camera, "shape": fit.mesh})
        typer.echo(f"  outlines differ by {fit.residual_px:.2f} pixels rms after {fit.steps} steps")
        typer.echo(f"  of the six directions of the pose the outline fixes {fit.identifiable}")
        typer.echo("  standard errors, turn in degrees and shift in mm: " + " ".join(f"{v:.3g}" for v in fit.stderr))
    else:
        circle = find_sphere(image)
        view = register_sphere(view, circle, rows, columns)
        typer.echo(
            f"  centre at row {circle.row:.2f} +- {circle.row_stderr:.2f}, column {circle.column:.2f} +- "
            f"{circle.column_stderr:.2f}; radius {circle.radius:.2f} +- {circle.radius_stderr:.2f} pixels"
        )
        typer.echo(f"  {100 * circle.arc:.0f} % of the outline seen")
    write_whole_text(out, dump_yaml(view))
    typer.echo(str(out))
