"""The results of finished cases in a folder, so that a long sweep goes on where it was cut, or in several places."""

from __future__ import annotations

import functools
import hashlib
import pickle
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import automodel
from automodel.config import ConfigError
from automodel.output_files import output_path

_ROOT = Path(automodel.__file__).resolve().parents[1]
_PACKAGES = ("automodel", "calibration", "firmware_link", "tracks")
_DIGEST_BYTES = hashlib.sha256().digest_size  # a file begins with that of the rest
_CODE = (".py", ".onnx", ".toml", ".cpp", ".h", ".ino", ".dbc")


class KeptResults:
    """A file for each finished case of a piece of work.

    Its name is the digest of the program's code, the work with its arguments, and the case: what another version, other
    options or another car.toml found is never taken. Results are pickled: use a folder that nobody else writes to.
    Raises ConfigError for a folder that cannot be made.
    """

    def __init__(self, folder: Path, work: Callable[..., Any]) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"--keep {folder}: cannot be made: {error.strerror}") from None
        self._folder = folder
        self._work = f"{code_digest()} {_described(work)}"

    def has(self, case: object) -> bool:
        """Whether there is a whole result of this case."""
        try:
            self.get(case)
        except KeyError:
            return False
        return True

    def get(self, case: object) -> Any:
        """The result of this case; raises KeyError where there is none, or a damaged one."""
        path = self._path(case)
        try:
            whole = path.read_bytes()
        except OSError:
            raise KeyError(case) from None
        digest, data = whole[:_DIGEST_BYTES], whole[_DIGEST_BYTES:]
        if hashlib.sha256(data).digest() != digest:  # what is damaged may unpickle as anything
            raise KeyError(case)
        return pickle.loads(data)

    def put(self, case: object, result: object) -> None:
        """Keep a result; raises ConfigError where it cannot be written."""
        with output_path(self._path(case)) as part:
            data = pickle.dumps(result, protocol=5)
            part.write_bytes(hashlib.sha256(data).digest() + data)

    def _path(self, case: object) -> Path:
        text = f"{self._work} {_stable(case)}"
        return self._folder / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.result"


@functools.cache
def code_digest() -> str:
    """Of all files of the program that results may depend on."""
    digest = hashlib.sha256()
    for name in _PACKAGES:
        for path in sorted((_ROOT / name).rglob("*")):
            if path.suffix in _CODE:
                digest.update(f"{path.relative_to(_ROOT)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


@functools.cache
def commit() -> str | None:
    """The commit of the checkout that runs, with "+changes" where files differ from it; None without a checkout."""
    if not (_ROOT / ".git").exists():
        return None
    try:
        told = [
            subprocess.run(("git", "-C", str(_ROOT), *words), capture_output=True, text=True, check=True).stdout.strip()
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        ]
    except (OSError, subprocess.CalledProcessError):
        return None
    return told[0] + ("+changes" if told[1] else "")


def _described(work: Callable[..., Any]) -> str:
    """A function, or one with arguments bound, in the same words in every process."""
    if isinstance(work, functools.partial):
        return f"{_described(work.func)} {_stable(work.args)} {_stable(work.keywords)}"
    return f"{work.__module__}.{work.__name__}"


def _stable(value: object) -> str:
    text = repr(value)
    if re.search(r" at 0x[0-9a-f]+", text):
        raise ValueError(f"a case that cannot be kept: {text[:200]} has no value of its own")
    return text
