"""Light through the air: known columns, energy, and the illuminances that people have measured from noon to starlight."""

import math
from pathlib import Path

import numpy as np
import pytest

from gi_core.air import ColumnsAt, disc_share
from gi_core.air import _table as air_table
from gi_core.air_profile import TOP_KM, densities
from gi_core.atmosphere import Atmosphere, atmosphere
from gi_core.lighting_model import beam_irradiance
from gi_core.sky import clear_sky, horizontal_illuminance, map_directions, with_clouds
from gi_core.spectrum import LUMINANCE_FROM_RGB, RGB_FROM_SPECTRUM, SOLAR_ILLUMINANCE_LX, WAVELENGTH_NM, rayleigh_depth
from gi_core.sun import refraction_degrees, without_refraction
from gi_core.weather import parse_weather

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"
SUN = np.ones(8)


def towards(elevation_degrees: float, azimuth: float = 0.0) -> np.ndarray:
    e = math.radians(elevation_degrees)
    return np.array([math.cos(e) * math.cos(azimuth), math.sin(e), math.cos(e) * math.sin(azimuth)])


def luminance(rgb: np.ndarray) -> float:
    return float(LUMINANCE_FROM_RGB @ rgb)


def diffuse_and_beam(air: Atmosphere, elevation: float) -> tuple[np.ndarray, np.ndarray]:
    """Horizontal illuminance of the sky and normal illuminance of the beam, (3,) each."""
    sky = clear_sky(air, towards(elevation), SUN, 0.15)
    return horizontal_illuminance(sky), beam_irradiance(air, elevation, SUN)


def test_densities_integrate_to_one_and_are_the_standard_atmospheres() -> None:
    height = np.linspace(0, TOP_KM, 20001)
    values = densities(height)
    np.testing.assert_allclose(((values[1:] + values[:-1]) / 2 * np.diff(height)[:, None]).sum(axis=0), 1, rtol=1e-4)
    air = values[:, 0] / values[0, 0]
    # U.S. Standard Atmosphere 1976, density beside the sea's 1.225 kg/m3.
    for kilometres, kilograms in ((5, 0.7364), (10, 0.4135), (20, 0.0889), (40, 0.003996), (60, 3.097e-4)):
        assert np.interp(kilometres, height, air) == pytest.approx(kilograms / 1.225, rel=0.01)
    assert height[np.argmax(values[:, 2])] == pytest.approx(22, abs=1)  # the ozone layer


def columns_from_the_sea(elevation: float, seen: bool = True) -> np.ndarray:
    return ColumnsAt(np.array([0.0]), seen).towards(np.array([[math.sin(math.radians(elevation))]]))[0, 0]


def test_a_vertical_path_has_one_of_each_column_and_no_bend() -> None:
    np.testing.assert_allclose(columns_from_the_sea(90.0), [1, 1, 1, 0], rtol=2e-3, atol=1e-3)  # the table's trapezoids
    np.testing.assert_allclose(columns_from_the_sea(90.0, seen=False), [1, 1, 1, 0], rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize("elevation", [0.0, 1.0, 5.0, 10.0, 20.0, 45.0])
def test_columns_of_air_are_the_air_masses_of_kasten_and_young(elevation: float) -> None:
    air_mass = 1 / (math.sin(math.radians(elevation)) + 0.50572 * (elevation + 6.07995) ** -1.6364)
    # Theirs follows refracted rays, ours straight ones that start at the elevation as it is seen.
    assert columns_from_the_sea(elevation)[0] == pytest.approx(air_mass, rel=0.08 if elevation < 5 else 0.011)


@pytest.mark.parametrize("true", [-0.5, 0.0, 1.0, 3.0, 10.0, 45.0])
def test_air_bends_light_as_saemundssons_formula_does(true: float) -> None:
    seen = true + refraction_degrees(true, 1013.0, 15.0)
    # One light, asked for by either elevation; a hundredth of the columns is 0.01 degrees at the horizon.
    np.testing.assert_allclose(columns_from_the_sea(true, seen=False)[:3], columns_from_the_sea(seen)[:3], rtol=0.02)
    assert without_refraction(seen, 1013.0, 15.0) == pytest.approx(true, abs=1e-9)


def test_refraction_thins_a_beam_by_as_much_as_it_flattens_the_sun() -> None:
    for seen in (0.5, 2.0, 10.0):
        edges = [without_refraction(seen + offset, 1013.0, 15.0) for offset in (-0.25, 0.25)]
        assert math.exp(-columns_from_the_sea(seen)[3]) == pytest.approx(0.5 / (edges[1] - edges[0]), rel=0.02)


def test_from_space_the_sun_sets_behind_twice_the_refraction() -> None:
    # A ray that grazes the sea turns on the way in and on the way out.
    table = air_table()
    lift = np.degrees(np.arcsin(table.seen_horizon) - np.arcsin(table.true_horizon))
    assert lift[0] == pytest.approx(0.567, abs=0.01)
    assert lift[-1] == pytest.approx(2 * lift[0], rel=0.02)
    assert (np.diff(lift) > -1e-3).all()  # 0.1 % of the columns


def test_disc_share_is_zero_up_to_the_horizon_then_rises_smoothly_to_one() -> None:
    elevation = np.arange(-1, 1, 1e-4)
    share = disc_share(elevation)
    assert (share[elevation <= 0] == 0).all()
    assert (share[elevation > 0.5333] == 1).all()
    assert (np.diff(share) >= 0).all()
    assert np.diff(share).max() < 3e-4  # no step: 1e-4 degrees of a disc of 0.53


def test_the_sun_above_the_air_is_the_solar_constant_and_nearly_white() -> None:
    rgb = RGB_FROM_SPECTRUM.sum(axis=1)
    assert luminance(rgb) == pytest.approx(SOLAR_ILLUMINANCE_LX, rel=1e-3)  # the matrices have four digits
    assert rgb.max() / rgb.min() < 1.2


def test_clean_airs_optical_depth_at_550_nm() -> None:
    # Bodhaine et al. 1999: 0.0972 at 550 nm and standard pressure.
    assert np.interp(550, WAVELENGTH_NM, rayleigh_depth()) == pytest.approx(0.0972, rel=0.03)


def test_the_sky_gives_back_no_more_than_the_beam_lost() -> None:
    air = atmosphere(0.15, 0.0)
    for elevation in (5.0, 20.0, 50.0, 90.0):
        sky, beam = diffuse_and_beam(air, elevation)
        above = RGB_FROM_SPECTRUM.sum(axis=1) * math.sin(math.radians(elevation))
        total = sky + beam * math.sin(math.radians(elevation))
        assert (total < above * 1.001).all()
        # And of what was lost, a good part comes down again.
        assert luminance(total) > (0.35 if elevation < 10 else 0.6) * luminance(above)


def test_thick_white_haze_transmits_what_two_streams_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gi_core.atmosphere.AEROSOL_ALBEDO", 1.0)
    air = Atmosphere(2.0, 0.0)
    sky = horizontal_illuminance(clear_sky(air, towards(90.0), SUN, 0.0))
    beam = beam_irradiance(air, 90.0, SUN)
    # Similarity: depth (1 - g) of aerosol, all of the air's; ozone hardly matters in red. The series takes later bounces as isotropic.
    depth = 0.3 * 2.0 * (600 / 550) ** -1.3 + float(np.interp(600, WAVELENGTH_NM, rayleigh_depth()))
    assert (sky + beam)[0] / RGB_FROM_SPECTRUM.sum(axis=1)[0] == pytest.approx(1 / (1 + 0.75 * depth), rel=0.08)


def test_colours_of_the_sky() -> None:
    air = atmosphere(0.15, 0.0)
    noon = clear_sky(air, towards(50.0), SUN, 0.15)
    opposite = noon[8, 64]  # 23 degrees from the zenith, away from the sun
    assert opposite[2] > 1.3 * opposite[0]
    sunset = clear_sky(air, towards(1.0), SUN, 0.15)
    assert sunset[30, 0, 0] > 1.5 * sunset[30, 0, 2]  # the horizon below the sun is red
    assert sunset[0, 0, 2] > sunset[0, 0, 0]  # the zenith is still blue, by ozone
    twilight = clear_sky(air, towards(-4.0), SUN, 0.15)
    assert luminance(twilight[28, 0]) > 3 * luminance(twilight[28, 64])  # brighter where the sun went down
    low, high = (beam_irradiance(air, elevation, SUN) for elevation in (4.0, 60.0))
    assert low[0] / low[2] > 5 > high[0] / high[2]


def test_the_sky_is_symmetric_about_the_sun_and_turns_with_it() -> None:
    air = atmosphere(0.15, 0.0)
    column = 2 * math.pi / 128
    sky = clear_sky(air, towards(20.0, 0.0), SUN, 0.15)
    np.testing.assert_allclose(sky, sky[:, ::-1], rtol=1e-9)
    turned = clear_sky(air, towards(20.0, 37 * column), SUN, 0.15)
    np.testing.assert_allclose(turned, np.roll(sky, 37, axis=1), rtol=1e-6)


def test_a_map_is_brightest_around_the_sun() -> None:
    sky = clear_sky(atmosphere(0.15, 0.0), towards(30.0, 2.0), SUN, 0.15) @ LUMINANCE_FROM_RGB
    brightest = map_directions().reshape(-1, 3)[np.argmax(sky)]
    # The aureole is broad, and leans towards the horizon where there is more air.
    assert brightest @ towards(30.0, 2.0) > math.cos(math.radians(8))
    assert math.atan2(brightest[2], brightest[0]) == pytest.approx(2.0, abs=math.pi / 128)


def test_more_haze_dims_the_beam_and_brightens_the_sky() -> None:
    thin, thick = (diffuse_and_beam(atmosphere(haze, 0.0), 40.0) for haze in (0.05, 0.5))
    assert luminance(thick[1]) < luminance(thin[1])
    assert luminance(thick[0]) > luminance(thin[0])


def typical_year() -> np.ndarray:
    """(hours, 4): the sun's elevation, beam and diffuse illuminance [lx], opaque tenths of cloud, of New York's typical year."""
    import ephem

    path = SHARED / "newyork_tmy3.epw"
    if not path.exists():
        pytest.skip("New York's typical year is not here")
    rows = []
    for line in path.read_text().splitlines()[8:]:
        field = line.split(",")
        observer = ephem.Observer()
        observer.lat, observer.lon, observer.pressure = "40.78", "-73.97", 0
        # Hours are stamped at their end, in standard time.
        observer.date = ephem.Date(tuple(int(v) for v in field[:3])) + (float(field[3]) - 0.5 + 5) / 24
        sun = ephem.Sun(observer)
        rows.append((math.degrees(sun.alt), float(field[17]), float(field[18]), float(field[23])))
    return np.array(rows)


def test_presets_lie_where_new_yorks_typical_year_does() -> None:
    year = typical_year()
    for preset, tenths, tolerance in (("clear", (0, 0), 0.3), ("partly_cloudy", (4, 6), 0.3), ("overcast", (10, 10), 0.4)):
        weather = parse_weather(preset)
        air = atmosphere(weather.haze, 0.0)
        # Lower, the sides of clouds hide more of the beam than their share of the sky; we leave that out.
        for elevation in (27.5, 37.5, 47.5, 57.5):
            same = (np.abs(year[:, 0] - elevation) < 2.5) & (year[:, 3] >= tenths[0]) & (year[:, 3] <= tenths[1])
            assert same.sum() > 10
            beam = beam_irradiance(air, elevation, SUN)
            sky = clear_sky(air, towards(elevation), SUN, 0.15)
            clouded = with_clouds(sky, beam * math.sin(math.radians(elevation)), weather.cloud_cover, weather.cloud_transmission)
            # Medians of a few dozen modelled hours; our overcast is meant to be gloomier than the median one.
            assert luminance(horizontal_illuminance(clouded)) == pytest.approx(np.median(year[same, 2]), rel=tolerance)
            assert luminance(beam) * (1 - weather.cloud_cover) == pytest.approx(np.median(year[same, 1]), rel=tolerance, abs=500)
