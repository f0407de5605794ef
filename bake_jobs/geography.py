"""From a map's coordinates to longitude and latitude, from those to the world frame, and from a place to its time zone."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from tzfpy import get_tz

from gi_core.arrays import Float64
from gi_core.errors import SourceError
from gi_core.world import world_from_east_north


@dataclass(frozen=True)
class MapFrame:
    """A world frame whose origin lies at a place on Earth. Distances from the origin are true (azimuthal equidistant)."""

    latitude_degrees: float
    longitude_degrees: float
    north_degrees: float = 0.0

    def world_from_lonlat(self, lonlat: Float64) -> Float64:
        """World x and z (n, 2) [m] of WGS84 longitudes and latitudes (n, 2) [degrees]; inf where a point cannot be projected."""
        local = CRS.from_proj4(f"+proj=aeqd +lat_0={self.latitude_degrees!r} +lon_0={self.longitude_degrees!r} +datum=WGS84 +units=m")
        east, north = Transformer.from_crs("EPSG:4326", local, always_xy=True).transform(lonlat[:, 0], lonlat[:, 1])
        return np.stack(world_from_east_north(np.asarray(east), np.asarray(north), self.north_degrees), axis=1)


def centre_of(lonlat: Float64) -> tuple[float, float]:
    """Latitude and longitude of the middle of some places (n, 2), rounded to 0.0001 degrees so that a small edit does not move a world."""
    middle = (lonlat.min(axis=0) + lonlat.max(axis=0)) / 2
    return round(float(middle[1]), 4), round(float(middle[0]), 4)


def lonlat_from(points: Float64, system: str, where: str) -> Float64:
    """WGS84 longitude and latitude (n, 2) of points (n, 2), x, y as files store them: easting or longitude first, whatever the system says.

    system : its name, URN or URL, such as EPSG:25832, urn:ogc:def:crs:OGC:1.3:CRS84, http://www.opengis.net/def/crs/EPSG/0/7415

    Raises SourceError for a system that is unknown or has no plane, and for points beyond it.
    """
    try:
        crs = CRS.from_user_input(system)
        # Heights are kept as they are, so of a compound system only the horizontal part matters.
        horizontal = crs.sub_crs_list[0] if crs.is_compound else crs
        if not (horizontal.is_geographic or horizontal.is_projected):
            raise ProjError(f"it is a {crs.type_name}")
        x, y = Transformer.from_crs(horizontal, "EPSG:4326", always_xy=True).transform(points[:, 0], points[:, 1])
    except (ProjError, UnicodeError) as error:
        raise SourceError(
            f"{where}: expected a coordinate system of maps that PROJ knows, as EPSG:4326, found {system[:80]!r} ({str(error)[:200]})"
        ) from error
    lonlat = np.stack([np.asarray(x), np.asarray(y)], axis=1)
    if not np.isfinite(lonlat).all():
        raise SourceError(f"{where}: expected coordinates inside the area of {system[:80]}, found some that have no place there")
    return lonlat


def lonlat_of_geojson(points: Float64, document: dict[str, Any], where: str) -> Float64:
    """WGS84 longitude and latitude (n, 2) of a GeoJSON's positions (n, 2).

    They are that already (RFC 7946) but for files with a ``crs`` member, which GeoJSON had until 2016 and its writers still have. Raises
    SourceError as ``lonlat_from`` does, and for a ``crs`` without a name.
    """
    crs = document.get("crs")
    if crs is None:
        return points
    properties = crs.get("properties") if isinstance(crs, dict) and crs.get("type") == "name" else None
    name = properties.get("name") if isinstance(properties, dict) else None
    if not isinstance(name, str):
        expected = '{"type": "name", "properties": {"name": "EPSG:..."}}'
        raise SourceError(f"{where}: crs: expected {expected}, found {str(crs)[:80]}; take it out of a file in longitude and latitude")
    return lonlat_from(points, name, f"{where}: crs")


def timezone_at(latitude_degrees: float, longitude_degrees: float) -> str:
    """IANA name of the time zone at a place; at sea, a zone of whole hours."""
    return str(get_tz(longitude_degrees, latitude_degrees) or "UTC")
