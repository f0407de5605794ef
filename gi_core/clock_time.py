"""Times as people write them, read in the world's own time zone."""

import re
from datetime import UTC, date, datetime, time
from zoneinfo import ZoneInfo

from gi_core.errors import InputError, UnknownTimeError
from gi_core.world import Location

# Calendars and time zones outside these years are conjecture, and nobody lights a city there.
FIRST_YEAR, LAST_YEAR = 1600, 2599
ALLOWED_TIMES = "HH:MM, HH:MM:SS, or ISO 8601 local time such as 2024-06-21T13:00 (an offset like -04:00 or Z may follow)"

_CLOCK = r"(?P<hour>\d{2}):(?P<minute>\d{2})(?::(?P<second>\d{2}))?"
_TIME = re.compile(rf"(?:(?P<date>\d{{4}}-\d{{2}}-\d{{2}})[T ])?{_CLOCK}(?P<offset>Z|[+ -]\d{{2}}:\d{{2}})?", re.ASCII)
_LONGEST_ECHO = 60


def parse_time(text: str, location: Location) -> datetime:
    """An aware datetime in ``location.timezone``.

    ``13:00`` and ``13:00:30`` mean ``location.date``; ISO 8601 names its own date. An offset is honoured and the result converted to
    the location's zone. Where clocks go back, a time that occurs twice means the first one (an offset tells the second). Where
    clocks go forward, a time that is skipped is read with the offset before the change: 02:30 becomes 03:30. The + of an offset may be a
    space, which is what a + becomes in a URL.

    Raises UnknownTimeError for anything else, and for years outside 1600..2599.
    """
    match = _TIME.fullmatch(text)
    if match is None or (match["offset"] and not match["date"]):
        raise UnknownTimeError(f"time {text[:_LONGEST_ECHO]!r}: expected {ALLOWED_TIMES}")
    try:
        day = date.fromisoformat(match["date"]) if match["date"] else location.date
        clock = time(int(match["hour"]), int(match["minute"]), int(match["second"] or 0))
        # ``Z`` and offsets go through the standard parser, which knows their bounds.
        offset = (match["offset"] or "").replace(" ", "+")
        moment = datetime.fromisoformat(f"{day.isoformat()}T{clock.isoformat()}{offset}")
    except ValueError as error:
        raise UnknownTimeError(f"time {text[:_LONGEST_ECHO]!r}: {error}; expected {ALLOWED_TIMES}") from error
    return local_time(moment, location)


def local_time(moment: datetime, location: Location) -> datetime:
    """The same moment as an aware datetime in ``location.timezone``; a naive one is read as local time.

    Raises UnknownTimeError for years outside 1600..2599, InputError for a time zone that does not exist.
    """
    if not FIRST_YEAR <= moment.year <= LAST_YEAR:
        raise UnknownTimeError(f"time {moment.isoformat()}: expected a year of {FIRST_YEAR}..{LAST_YEAR}, got {moment.year}")
    zone = time_zone(location.timezone)
    aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=zone)
    # By way of UTC, so that a local time which clocks skip becomes one that exists.
    return aware.astimezone(UTC).astimezone(zone)


def time_zone(name: str) -> ZoneInfo:
    """The IANA zone of a name. Raises InputError when there is none."""
    try:
        return ZoneInfo(name)
    # A name can also be malformed, or a folder of the database.
    except (KeyError, ValueError, OSError) as error:
        raise InputError(f"timezone {name[:_LONGEST_ECHO]!r}: expected an IANA name such as Europe/Berlin") from error
