"""Mitsuba's log: every kind of message once, as a warning; samples that are no radiances are counted."""

# pyright: basic
from __future__ import annotations

import logging
import re
from typing import Any, cast

INTERRUPTED = "Received interrupt signal"  # suppressed: the command line reports Ctrl-C itself
INVALID = "Invalid sample value"  # negative or not finite, one message per sample, which is then ignored
_HEADING = re.compile(r"\A[-\d]+ [:\d]+ \w+ +(\S+ +)?\[[^\]]*\] *")  # date, level, thread and line of a log message
_NUMBERS_AND_NAMES = re.compile(r"\d+|\"[^\"]*\"")
_APPENDERS: dict[str, Any] = {}
_seen: set[str] = set()
_invalid = {"samples": 0}


def redirect_log() -> None:
    """Hand Mitsuba's warnings to the log of Python."""
    import mitsuba as mi

    logger = cast(Any, mi).logger()
    if logger is not None and not isinstance(logger.appender(0), _log_appender()):
        logger.clear_appenders()
        appender: Any = _log_appender()
        logger.add_appender(appender())
        logger.set_log_level(mi.LogLevel.Warn)


def ignored_samples() -> int:
    """Return the number of samples that Mitsuba ignored since the last call, since they were no radiances."""
    count, _invalid["samples"] = _invalid["samples"], 0
    return count


def _append(text: str) -> None:
    message = _HEADING.sub("", text)
    kind = _NUMBERS_AND_NAMES.sub("", message)
    if INVALID in text:
        _invalid["samples"] += 1
    elif INTERRUPTED not in text and kind not in _seen:
        _seen.add(kind)
        logging.getLogger("mitsuba").warning("%s", message)


def _log_appender() -> Any:
    import mitsuba as mi

    if "log" not in _APPENDERS:

        class LogAppender(mi.Appender):
            def append(self, level: object, text: str) -> None:
                del level
                _append(text)

            def log_progress(self, *arguments: object) -> None:
                del arguments

        _APPENDERS["log"] = LogAppender
    return _APPENDERS["log"]
