"""Generated C to machine code: compiled once on a kind of machine, cached by content."""

import contextlib
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import time
from collections.abc import Collection, Sequence
from pathlib import Path

# -O2 takes a third longer to compile, hundreds of times in a diagnosis, and runs no faster.
# No -ffast-math: runaway states are found by comparisons that must see NaN.
FLAGS = (
    '-O1', '-ftree-vectorize', '-march=native', '-fno-math-errno', '-fno-trapping-math',
    '-fno-signed-zeros', '-fassociative-math', '-freciprocal-math', '-ffp-contract=fast',
)  # fmt: skip
UNDER_WAY = '.compiling_'  # then the process; folders in the cache
PRODUCTS = {'.so': ('-shared', '-fPIC'), '.o': ('-c', '-fPIC')}


def cache_directory() -> Path:
    """Where compiled models are kept; CG_CACHE overrides the user's cache directory.

    Absolute, as a library that is named by its file alone is looked for in the system's places.
    """
    default = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'compass_gait'
    return Path(os.environ.get('CG_CACHE') or default).absolute()


@functools.cache
def compiler() -> str | None:
    """Path of a C compiler, or None; CG_COMPILER overrides, empty means none."""
    named = os.environ.get('CG_COMPILER')
    if named is not None:
        return shutil.which(named) if named else None
    return next(filter(None, map(shutil.which, ('cc', 'gcc', 'clang'))), None)


def seconds_under_way(processes: Collection[int]) -> float:
    """How long the compiler has been at work for these processes, in s; 0 if it is not."""
    began = []
    for process in processes:
        for directory in cache_directory().glob(f'{UNDER_WAY}{process}_*'):
            with contextlib.suppress(FileNotFoundError):  # it has just finished
                began.append(directory.stat().st_mtime)
    return max(time.time() - min(began), 0.0) if began else 0.0


def shared_library(
    source: str, flags: Sequence[str] = FLAGS, objects: Sequence[Path] = ()
) -> Path:
    """A shared library of C source, from the cache if it was compiled before.

    Args:
        source: The C source; math.h is linked.
        flags: Of the compiler.
        objects: Object files that belong to it.
    """
    return _cached('.so', source, flags, objects)


def object_file(source: str, flags: Sequence[str] = FLAGS) -> Path:
    """The same, to be linked into shared libraries."""
    return _cached('.o', source, flags, ())


def _cached(kind: str, source: str, flags: Sequence[str], objects: Sequence[Path]) -> Path:
    # Names of objects are those of their content.
    names = [path.name for path in objects]
    key = '\n'.join([source, *flags, *names, str(compiler()), platform.machine(), _cpu()])
    target = cache_directory() / f'{hashlib.sha256(key.encode()).hexdigest()[:32]}{kind}'
    if not target.exists():
        build(source, target, flags, objects)
    return target


@functools.cache
def _cpu() -> str:
    # A cache on a shared home must not hand one machine the other's instructions.
    try:
        lines = Path('/proc/cpuinfo').read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith('flags')), '')


def build(
    source: str, target: Path, flags: Sequence[str] = FLAGS, objects: Sequence[Path] = ()
) -> None:
    """Compile C source to a file, a shared library or an object by its name's end.

    Raises:
        RuntimeError: if there is no compiler; with what it says, if it refuses.
    """
    gcc = compiler()
    if gcc is None:
        raise RuntimeError('no C compiler found (cc, gcc, clang)')
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(
        prefix=f'{UNDER_WAY}{os.getpid()}_', dir=target.parent
    ) as directory:
        c, made = Path(directory) / 'model.c', Path(directory) / 'made'
        c.write_text(source)
        files = [str(made), str(c), *map(str, objects)]
        command = [gcc, *flags, *PRODUCTS[target.suffix], '-o', *files, '-lm']
        # A signal to our group, as of Ctrl-C, is for us to hear: a compiler that dies of it looks
        # like one that refuses the model.
        result = subprocess.run(command, capture_output=True, text=True, start_new_session=True)
        if result.returncode:
            raise RuntimeError(f'{gcc} failed on a generated model:\n{result.stderr[:2000]}')
        # Two processes may build the same model; the last rename wins and both are equal.
        os.replace(made, target)
