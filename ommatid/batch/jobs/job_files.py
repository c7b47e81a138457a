"""Files by which jobs on several machines agree, on shared file systems without locks.

They rely on what such systems, NFS among them, promise: a link is made once, and a renamed file appears whole. All jobs
write into one folder, since a job that has written there sees what was written before, also where a system keeps old
listings of folders for a while.
"""

from __future__ import annotations

import os
from pathlib import Path

from ommatid.runtime.input_files import read_text


def replace_text(path: Path, text: str, temporary: Path) -> None:
    """Write a file atomically. `temporary` is a name in the same folder that only this job uses."""
    _fill(temporary, text)
    temporary.replace(path)


def claimed_text(path: Path, text: str, temporary: Path) -> str:
    """Write a file unless there is one, and return what stands there: one of several jobs finds its own text.

    temporary : a name in the same folder that only this job uses
    """
    while True:
        _fill(temporary, text)
        try:
            os.link(temporary, path)
        except FileExistsError:
            pass  # another job was first, and its text is what all of them read below
        except OSError:  # a file system without links, where two jobs that begin at the same moment are not kept apart
            if not path.exists():
                temporary.replace(path)
        temporary.unlink(missing_ok=True)
        try:
            return read_text(path)
        except FileNotFoundError:  # removed since
            continue


def _fill(path: Path, text: str) -> None:
    path.unlink(missing_ok=True)  # of a job that was killed: perhaps a link to a file that others read
    with path.open("x", encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
