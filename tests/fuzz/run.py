"""Fuzzes every reader and the engines for a time: `make fuzz`, or `python tests/fuzz/run.py --seconds 3600`.

Inputs are made by seeded mutation, one target after the other, in a process of its own that is started anew when it
dies, hangs or grows. What it finds is written to a folder and listed; copied to `found/TARGET/` it is a test.
"""

import argparse
import hashlib
import importlib.util
import multiprocessing
import os
import random
import re
import resource
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType

_LONGEST_S = 30.0  # for one input
_MEMORY = 6 * 2**30


def beside(name: str) -> ModuleType:
    """A module beside this file."""
    full = f"torchdof_fuzz_{name}"
    if full not in sys.modules:
        spec = importlib.util.spec_from_file_location(full, Path(__file__).with_name(f"{name}.py"))
        if spec is None or spec.loader is None:
            raise ImportError(f"{name}.py must lie beside this file")
        module = importlib.util.module_from_spec(spec)
        sys.modules[full] = module
        spec.loader.exec_module(module)
    return sys.modules[full]


def work(pipe: Connection, folder: str) -> None:
    """Takes names of targets with paths, answers with what is wrong; what is printed goes to a file."""
    targets = beside("targets").TARGETS
    import torch

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
        wrong = beside("targets").finding(targets[name], Path(path))
        if wrong is None and os.fstat(printed).st_size:
            wrong = "printed: " + os.pread(printed, 200, 0).decode(errors="replace").strip()
        pipe.send(wrong)


class Worker:
    """The process in which targets run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.process, self.pipe = folder, None, None

    def run(self, name: str, path: Path) -> str | None:
        """What is wrong with how a target takes a file."""
        if self.process is None:
            self.pipe, end = multiprocessing.Pipe()
            self.process = multiprocessing.get_context("spawn").Process(target=work, args=(end, str(self.folder)))
            self.process.start()
            end.close()
            self.pipe.recv()
        try:
            self.pipe.send((name, str(path)))
            if not self.pipe.poll(_LONGEST_S):
                self.stop()
                return f"takes longer than {_LONGEST_S:g} s"
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode
            self.stop()
            return f"ends the process with {code}"

    def stop(self) -> None:
        """End the process."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
        self.process = None


def main() -> None:
    """Fuzzes for the time given; exit code 1 if something was found."""
    targets = beside("targets").TARGETS
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--target", choices=targets, action="append", help="Repeat it for several; default: all.")
    parser.add_argument("--findings", type=Path, default=Path("build/fuzz"))
    arguments = parser.parse_args()
    names = arguments.target or list(targets)
    arguments.findings.mkdir(parents=True, exist_ok=True)
    rng, tried, found = random.Random(arguments.seed), dict.fromkeys(names, 0), {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        corpus = {}
        for name in names:
            (folder / name).mkdir()
            corpus[name] = list(beside("targets").seeds(targets[name], folder / name))
        worker, end = Worker(folder), time.monotonic() + arguments.seconds
        while time.monotonic() < end:
            for name in names:
                turn_s = min(5.0, arguments.seconds / len(names) / 2) * (4.0 if name == "engines" else 1.0)
                target, turn = targets[name], time.monotonic() + turn_s
                path = folder / ("capture.toml" if name == "manifest" else f"input{target.suffix}")
                while time.monotonic() < min(turn, end):
                    content = beside("mutate").mutated(rng.choice(corpus[name]), corpus[name], target.suffix, rng)
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
        print(f"{name:>10}: {count:8} inputs, {kinds} kinds of trouble")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
