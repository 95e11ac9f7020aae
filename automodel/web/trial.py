"""A pipeline once more over the frames of a run, with one key of car.toml changed, in a process of its own."""

from __future__ import annotations

import contextlib
import multiprocessing
import resource
import signal
from multiprocessing.connection import Connection

from automodel.assembly.parts import make_loop
from automodel.assembly.report import Eye, Seen
from automodel.config import CarConfig, ConfigError
from automodel.config.changes import keys_of
from automodel.runtime.os_signals import signals_held_back
from automodel.sources.errors import SourceError
from automodel.web.film import Footage

SECTIONS = ("camera.intrinsics.", "camera.extrinsics.", "camera.right.", "lane.")  # and that of the pipeline
NOT_OF_THE_LANE = ("threads", "model")  # of the machine; a page must not name files
MOST_BYTES = 2**33  # [byte] of memory that the process may ask for: a number that is far off may ask for any
TELL_FRAMES = 10  # between two words about how far it is

Word = int | str | list[Seen]  # frames done so far, what is wrong, what was seen


def changeable(eye: Eye) -> dict[str, object]:
    """The keys of car.toml that may change what a pipeline sees, with their values."""
    sections = (*SECTIONS, f"pipeline.{eye.car.pipeline.name}.")
    return {
        key: value
        for key, value in keys_of(eye.car)
        if key.startswith(sections)
        and key.rpartition(".")[2] not in NOT_OF_THE_LANE
        and isinstance(value, bool | int | float | str)
    }


class Trial:
    """The process, from its start until `close`; `next_word` waits for what it says."""

    def __init__(self, footage: Footage, car: CarConfig) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_see_again, args=(footage, car, theirs), daemon=True, name="automodel view"
        )
        with signals_held_back():
            self._process.start()
        theirs.close()

    def next_word(self) -> Word:
        """Frames so far, an error or, at last, everything seen; an error too where the process was ended."""
        try:
            word: Word = self._pipe.recv()  # from our own process
        except (EOFError, OSError):
            word = "the process ended before it was through; a smaller change may fit into the memory"
        return word

    def close(self) -> None:
        """End the process, however far it is; `next_word` then returns."""
        self._process.kill()
        self._process.join()


def _see_again(footage: Footage, car: CarConfig, pipe: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the server, which ends this process
    with contextlib.suppress(ValueError, OSError):  # less is allowed already
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    seen: list[Seen] = []
    try:
        eye = Eye(car.pipeline.name, car, make_loop(car))
        with footage.opened(car) as shots:
            for _, frame, moved, step in shots:
                seen.append(eye.see(frame, moved, step))
                if len(seen) % TELL_FRAMES == 0:
                    pipe.send(len(seen))
    except (ConfigError, SourceError) as error:
        pipe.send(str(error))
    except MemoryError:
        pipe.send("this value takes more memory than there is")
    else:
        pipe.send(seen)
