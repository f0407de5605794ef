"""Options that several commands share."""

from typing import Annotated

import typer

DeviceOption = Annotated[str | None, typer.Option(envvar="SECTORLIGHT_DEVICE", help="Part of an OpenCL device's name.")]
