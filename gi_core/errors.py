"""The project's errors, one tree; each is also the built-in that a caller would expect.

    SectorlightError
      InputError (ValueError)                 the user's input is wrong: exit status 2, HTTP 400
        UnknownWeatherError                   not a preset, nor an override of one
        UnknownTimeError                      neither HH:MM nor ISO 8601
        SourceError                           a mesh or map that cannot be baked
        OutsideWorldError (LookupError)       a position beyond the dataset: HTTP 404
        DeviceError                           no such OpenCL device
      SectorMissingError (FileNotFoundError)  the dataset has no such sector: HTTP 404
      FormatError                             a dataset file that must not be used: HTTP 503
        FormatVersionError                    written by another format version
        CorruptFileError                      truncated, tampered with, or inconsistent
      KernelBuildError (RuntimeError)         the device's compiler refused a kernel

Text says where, what was expected, what was found, and what to do. ``code`` is stable: clients may branch on it.
"""


class SectorlightError(Exception):
    """Base of all errors raised on purpose."""

    code = "internal"


class InputError(SectorlightError, ValueError):
    """The user's input is wrong."""

    code = "bad_input"


class UnknownWeatherError(InputError):
    code = "unknown_weather"


class UnknownTimeError(InputError):
    code = "unknown_time"


class SourceError(InputError):
    code = "bad_source"


class OutsideWorldError(InputError, LookupError):
    code = "outside_world"


class DeviceError(InputError):
    code = "no_such_device"


class SectorMissingError(SectorlightError, FileNotFoundError):
    code = "no_such_sector"


class FormatError(SectorlightError, ValueError):
    code = "bad_file"


class FormatVersionError(FormatError):
    code = "format_version"


class CorruptFileError(FormatError):
    code = "corrupt_file"


class KernelBuildError(SectorlightError, RuntimeError):
    code = "kernel_build"
