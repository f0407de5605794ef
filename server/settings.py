"""What the operator decides about a server. The command line and ``SECTORLIGHT_*`` variables fill it; nothing else reads them."""

import ipaddress
from dataclasses import dataclass, field, replace
from pathlib import Path

from gi_core.errors import InputError
from gi_core.user_sky import UserSky, user_sky
from gi_core.world import Location
from server.live import LiveOptions

MIN_TOKEN_LENGTH = 16  # shorter ones can be guessed over a network


@dataclass(frozen=True)
class SkyFile:
    """A picture that takes the place of the model's sky (gi_core.user_sky).

    path : .exr or .hdr, equirectangular; centre_azimuth_degrees : compass azimuth that its middle looks to
    illuminance_lx : of open level ground; None takes the picture's numbers as cd/m2
    holds_sun : the model's sun and moon then give nothing
    """

    path: Path
    centre_azimuth_degrees: float = 0.0
    illuminance_lx: float | None = None
    holds_sun: bool = False

    def read(self, location: Location) -> UserSky:
        """The sky over a place. Raises InputError."""
        found = user_sky(self.path, location.north_degrees, self.centre_azimuth_degrees, self.illuminance_lx)
        return replace(found, holds_sun=self.holds_sun)


@dataclass(frozen=True)
class Settings:
    """Options of one server process.

    host, port : where to listen; beyond loopback only with a token file
    device : part of an OpenCL device's name, or None for the engine's choice
    token_file : file whose stripped text is the bearer token of writes
    sky : in place of the model's, for queries and the live world
    live : of the live world; its device and sky are these
    """

    host: str = "127.0.0.1"
    port: int = 8000
    device: str | None = None
    token_file: Path | None = None
    sky: SkyFile | None = None
    live: LiveOptions = field(default_factory=LiveOptions)

    def checked(self) -> "Settings":
        """Itself, or InputError when a server must not start like this."""
        if not is_loopback(self.host) and self.token_file is None:
            raise InputError(
                f"--host {self.host} can be reached from other machines: expected --token-file FILE beside it, found none;"
                " give one, or listen on 127.0.0.1"
            )
        if self.token_file is not None:
            read_token(self.token_file)
        return self


def is_loopback(host: str) -> bool:
    """Whether only this machine can reach ``host``; a name other than localhost is taken to be reachable."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def read_token(path: Path) -> str:
    """The bearer token in a file; InputError when there is none worth the name."""
    try:
        with path.open("rb") as file:
            text = file.read(4096).decode("ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"token file {path}: expected a readable file with one line of ASCII text, found {error}") from error
    if len(text) < MIN_TOKEN_LENGTH or len(text.split()) != 1:
        raise InputError(
            f"token file {path}: expected one word of at least {MIN_TOKEN_LENGTH} characters, found {len(text)} characters;"
            " `openssl rand -hex 32` makes a good one"
        )
    return text
