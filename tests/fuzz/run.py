"""Fuzzes the readers and both engines: ``make fuzz``, or ``python -m tests.fuzz.run --seconds 3600``.

Targets take turns on inputs from seeded mutation. They run in a worker process, which is started again when it dies,
hangs or exceeds its memory. Findings are written to ``--findings`` and printed; a file that is copied to
``found/TARGET/`` becomes a test.
"""

import argparse
import hashlib
import multiprocessing
import os
import random
import re
import resource
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

import torch

from tests.fuzz import targets
from tests.fuzz.mutate import mutated
from tests.fuzz.targets import TARGETS

_TIMEOUT_S = 120.0  # for one input; a busy machine needs seconds for some
_MEMORY = 6 * 2**30  # address space of the worker in bytes


def work(pipe: Connection, folder: str) -> None:
    """Receives (target, path) through the pipe and sends the finding, or None. Output is captured in a file."""
    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    printed = os.open(Path(folder) / "printed", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(printed, 1)
    os.dup2(printed, 2)
    pipe.send(None)
    while True:
        name, path = pipe.recv()
        os.ftruncate(printed, 0)
        os.lseek(printed, 0, os.SEEK_SET)
        wrong = targets.finding(TARGETS[name], Path(path))
        lines = os.pread(printed, 10_000, 0).decode(errors="replace").splitlines()
        lines = [line for line in lines if line and not line.startswith("libpng ")]
        if wrong is None and lines:
            wrong = f"printed: {lines[0][:200]}"
        pipe.send(wrong)


class Worker:
    """The process in which targets run; started on demand."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.running: tuple[SpawnProcess, Connection] | None = None

    def run(self, name: str, path: Path) -> str | None:
        """The finding of a target on a file, or None."""
        process, pipe = self.running or self._start()
        try:
            pipe.send((name, str(path)))
            if not pipe.poll(_TIMEOUT_S):
                self.stop()
                return f"takes longer than {_TIMEOUT_S:g} s"
            answer: str | None = pipe.recv()
            return answer
        except (EOFError, OSError):
            process.join()
            self.running = None
            return f"ends the process with {process.exitcode}"

    def _start(self) -> tuple[SpawnProcess, Connection]:
        pipe, end = multiprocessing.Pipe()
        process = multiprocessing.get_context("spawn").Process(target=work, args=(end, str(self.folder)))
        process.start()
        end.close()
        pipe.recv()
        self.running = process, pipe
        return self.running

    def stop(self) -> None:
        """End the process."""
        if self.running is not None:
            self.running[0].kill()
            self.running[0].join()
        self.running = None


def main() -> None:
    """Fuzzes for ``--seconds``; exit code 1 if there is a finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", choices=TARGETS, action="append", help="Repeat it for several; default: all.")
    parser.add_argument("--findings", type=Path, default=Path("build/fuzz"))
    arguments = parser.parse_args()
    names = arguments.target or list(TARGETS)
    arguments.findings.mkdir(parents=True, exist_ok=True)
    rng, tried, found = random.Random(arguments.seed), dict.fromkeys(names, 0), {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        corpus = {}
        for name in names:
            (folder / name).mkdir()
            corpus[name] = list(targets.seeds(TARGETS[name], folder / name))
        worker, end = Worker(folder), time.monotonic() + arguments.seconds
        while time.monotonic() < end:
            for name in names:
                turn_s = min(5.0, arguments.seconds / len(names) / 2) * (4.0 if name == "engines" else 1.0)
                target, turn = TARGETS[name], time.monotonic() + turn_s
                path = folder / ("capture.toml" if name == "manifest" else f"input{target.suffix}")
                while time.monotonic() < min(turn, end):
                    content = mutated(rng.choice(corpus[name]), corpus[name], target.suffix, rng)
                    path.write_bytes(content)
                    tried[name] += 1
                    wrong = worker.run(name, path)
                    kind = (name, re.sub(r"\d+|0x\w+", "0", wrong or "")[:50])
                    if wrong and kind not in found:
                        kept = arguments.findings / f"{name}-{hashlib.sha256(content).hexdigest()[:10]}{target.suffix}"
                        kept.write_bytes(content)
                        found[kind] = kept
                        print(f"FOUND {name}: {wrong} ({kept})", flush=True)
        worker.stop()
    for name, count in tried.items():
        kinds = sum(target == name for target, _ in found)
        print(f"{name:>10}: {count:8} inputs, {kinds} kinds of findings")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
