"""Logging to standard output: one record a line for journald, time of day for a terminal."""

from __future__ import annotations

import logging
import os
import sys

_SYSLOG_PRIORITY = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}
_RECORD = "%(name)s: %(message)s"


class _JournalFormatter(logging.Formatter):
    """`<6>name: text`: journald reads the priority and adds the time; a trace joins its record's line."""

    def format(self, record: logging.LogRecord) -> str:
        priority = _SYSLOG_PRIORITY.get(record.levelname, 6)
        return f"<{priority}>" + " | ".join(super().format(record).splitlines())


def setup(level: str = "INFO") -> None:
    """Send records of this level and above to standard output. Raises ValueError for an unknown level."""
    handler = logging.StreamHandler(sys.stdout)
    # systemd sets JOURNAL_STREAM when the output goes to the journal (systemd.exec(5)).
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(_JournalFormatter(_RECORD))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s " + _RECORD, "%H:%M:%S"))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)
