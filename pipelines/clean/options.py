"""Options of `georef clean`."""

from pydantic import Field

from pipelines.survey.options import CropOptions


class CleanOptions(CropOptions):
    """Options of the cleaned model.

    Gaussians go that are too transparent, float before the surface or far from everything, or lie outside a crop.
    --gaussians keeps those that show most, merges the others into them, and fits them to the renders of the
    trained model. The PSNR of the test views is stated before and after. The files of the splat (PLY, SPZ, tiles)
    then take the cleaned model, as long as it was made from the trained one as it is; rasters, cloud and mesh keep
    the trained one.

    Examples:
      georef clean flight
      georef clean flight --gaussians 1500000
      georef clean flight --crop --sh-degree 1 --gaussians 500000
    """

    floaters: bool = Field(
        True,
        description="Remove what floats: Gaussians before the surface that the photographs measure, or far from "
        "all others, that are translucent or that the photographs contradict.",
    )
    floater_sigma: float = Field(
        4.0,
        ge=1,
        le=100,
        description="A Gaussian further before the surface floats, in σ of the surface's depth and of the Gaussian "
        "along the ray.",
    )
    sh_degree: int | None = Field(
        None,
        ge=0,
        le=3,
        description="Largest degree of the spherical harmonics. Without it: that of the trained model.",
    )
    gaussians: int | None = Field(
        None,
        ge=1,
        description="Largest number of Gaussians: those that show least in training views are merged into their "
        "neighbours. Without it: all stay.",
    )
    refit_passes: int = Field(
        8,
        ge=0,
        le=1000,
        description="With --gaussians or --sh-degree: passes over the training views, in which what stays is "
        "fitted to the renders of the trained model.",
    )
