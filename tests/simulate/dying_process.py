"""Stands in for the process that tries worlds: ends in the way that the world's text names."""

from __future__ import annotations

import json
import os
import signal
import sys
import time


def main() -> None:
    text = json.loads(sys.stdin.buffer.readline())["text"]
    print(json.dumps({"at": "/somewhere/cup.ply"}), flush=True)
    if "hang" in text:
        time.sleep(600)
    elif "code" in text:
        os._exit(3)
    elif "memory" in text:
        print(json.dumps({"reason": "std::bad_alloc"}), flush=True)
    else:
        os.kill(os.getpid(), signal.SIGSEGV)
