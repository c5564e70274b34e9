"""Fuzzes the readers and both engines: ``make fuzz``, or ``python -m tests.fuzz.run --seconds 3600``.

Targets take turns on inputs from seeded mutation. A turn is a process with limited memory, which writes each input to a
file before it reads it. If it dies, hangs or finds a fault, that file is a finding: it is copied to ``--findings``. A
file that is copied to ``found/TARGET/`` becomes a test.
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
from pathlib import Path

import torch

from tests.fuzz import targets
from tests.fuzz.mutate import mutated
from tests.fuzz.targets import TARGETS

_TIMEOUT_S = 120.0  # for one input; a busy machine needs seconds for some
_MEMORY = 6 * 2**30  # address space of a turn in bytes


def turn(name: str, folder: Path, seed: int, seconds: float) -> None:
    """Reads mutated inputs for some seconds, until one is a finding; its description is written to a file."""
    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    printed = os.open(folder / "printed", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(printed, 1)
    os.dup2(printed, 2)
    (folder / "seeds").mkdir()
    target, rng, end = TARGETS[name], random.Random(seed), time.monotonic() + seconds
    corpus, path = list(targets.seeds(target, folder / "seeds")), input_of(name, folder)
    while time.monotonic() < end:
        path.write_bytes(mutated(rng.choice(corpus), corpus, target.suffix, rng))
        wrong = targets.finding(target, path)
        lines = os.pread(printed, 10_000, 0).decode(errors="replace").splitlines()
        lines = [line for line in lines if line and not line.startswith("libpng ")]
        if wrong or lines:
            (folder / "finding").write_text(wrong or f"printed: {lines[0][:200]}")
            return
        os.ftruncate(printed, 0)
        os.lseek(printed, 0, os.SEEK_SET)


def input_of(name: str, folder: Path) -> Path:
    """File of the inputs of a target."""
    return folder / ("capture.toml" if name == "manifest" else f"input{TARGETS[name].suffix}")


def finding_of_turn(name: str, folder: Path, seed: int, seconds: float) -> str | None:
    """The finding of a turn, or None."""
    process = multiprocessing.get_context("spawn").Process(target=turn, args=(name, folder, seed, seconds))
    process.start()
    process.join(seconds + _TIMEOUT_S)
    if process.is_alive():
        process.kill()
        return f"takes longer than {_TIMEOUT_S:g} s"
    if (folder / "finding").exists():
        return (folder / "finding").read_text()
    return f"ends the process with {process.exitcode}" if process.exitcode else None


def main() -> None:
    """Fuzzes for ``--seconds``; exit code 1 if there is a finding."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", choices=TARGETS, action="append", help="Repeat it for several; default: all.")
    parser.add_argument("--findings", type=Path, default=Path("build/fuzz"))
    arguments = parser.parse_args()
    names, kinds = arguments.target or list(TARGETS), set[tuple[str, str]]()
    arguments.findings.mkdir(parents=True, exist_ok=True)
    seed, end = arguments.seed, time.monotonic() + arguments.seconds
    while (left := end - time.monotonic()) > 0:
        name = names[seed % len(names)]
        with tempfile.TemporaryDirectory() as folder:
            wrong = finding_of_turn(name, Path(folder), seed, min(30.0, left))
            kind = (name, re.sub(r"\d+|0x\w+", "0", wrong or "")[:50])
            if wrong and kind not in kinds:
                kinds.add(kind)
                path = input_of(name, Path(folder))
                content = path.read_bytes() if path.exists() else b""  # a turn may end before its first input
                digest = hashlib.sha256(content).hexdigest()[:10]
                kept = arguments.findings / f"{name}-{digest}{TARGETS[name].suffix}"
                kept.write_bytes(content)
                print(f"FOUND {name}: {wrong} ({kept})", flush=True)
        seed += 1
    print(f"{seed - arguments.seed} turns, {len(kinds)} kinds of findings")
    sys.exit(1 if kinds else 0)


if __name__ == "__main__":
    main()
