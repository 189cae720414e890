"""Traced and compiled programs kept between runs, so that only the first run waits for the compiler."""

import dataclasses
import os
import pathlib
import stat
import warnings
from collections.abc import Mapping

import jax
from jax.experimental.compilation_cache import compilation_cache

from jaxbox.run import compiled
from jaxbox.run.checked_entries import check_entries
from jaxbox.run.programs import KeptPrograms

CACHE_VARIABLE = "JAXBOX_CACHE_DIR"
"""Environment variable that names another folder, or, when empty, switches the cache off."""

PROGRAMS = "programs"
"""Folder of the traced programs within that of the cache."""

_PRIVATE = 0o700
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_ROOT = 0
_chosen_here: set[str] = set()
"""Folders that JAX's cache was given by `keep_compiled`, and not by the user."""


class CacheWarning(UserWarning):
    """Why nothing is kept."""


def enable_cache(folder: str | os.PathLike[str] | None = None) -> pathlib.Path | None:
    """Keeps what is compiled between processes, so that only the first one waits for the compiler.

    From then on `detect` reads its traced program, which may have come with the installation, instead of
    tracing it, and compiles its two halves side by side, or loads them from JAX's compilation cache. The
    answers are the same, bit for bit. Under `jax.jit`, `jax.vmap` and the like it is traced as ever.

    Whoever can write to the folder can run code as you: one that belongs to another user, or that others may
    write to, is refused with a `CacheWarning`. JAX's compilation cache stays where it is if you have set it
    up before; but where others may write there, it is switched off, with a `CacheWarning` too.

    Args:
      folder: made where it is missing, for you alone; None for ``JAXBOX_CACHE_DIR``, else ``jaxbox`` within
        ``XDG_CACHE_HOME``, else ``~/.cache/jaxbox``.

    Returns:
      The folder; None where none is used: ``JAXBOX_CACHE_DIR`` is empty, which leaves the cache off, or the
      folder was refused.

    >>> enable_cache()  # doctest: +SKIP
    PosixPath('/home/ada/.cache/jaxbox')
    """
    chosen = cache_folder(os.environ) if folder is None else pathlib.Path(folder)
    if chosen is None:
        return None
    problem = make_private(chosen) or make_private(chosen / PROGRAMS)
    if problem:
        warnings.warn(f"{problem} Nothing is kept between runs.", CacheWarning, stacklevel=2)
    kept = None if problem else chosen
    if problem := _problem_of_jaxs():
        warnings.warn(f"{problem} JAX's compilation cache is off.", CacheWarning, stacklevel=2)
        _move_jaxs(None)
    elif kept is not None:
        keep_compiled(kept)
    compiled.use_programs(KeptPrograms(None if kept is None else kept / PROGRAMS))
    return kept


def cache_folder(environment: Mapping[str, str]) -> pathlib.Path | None:
    """Where programs are kept unless a folder is named; None where the cache is switched off.

    Args:
      environment: the environment variables.

    Returns:
      ``JAXBOX_CACHE_DIR``, else ``jaxbox`` within ``XDG_CACHE_HOME``, else ``~/.cache/jaxbox``.

    >>> cache_folder({"JAXBOX_CACHE_DIR": ""}) is None
    True
    """
    chosen = environment.get(CACHE_VARIABLE)
    if chosen is not None:
        return pathlib.Path(chosen) if chosen else None
    root = environment.get("XDG_CACHE_HOME")
    return (pathlib.Path(root) if root else pathlib.Path.home() / ".cache") / "jaxbox"


def make_private(folder: pathlib.Path) -> str | None:
    """Makes a folder for its owner alone, or looks at one that is there.

    Args:
      folder: of programs that will be run.

    Returns:
      Why it must not be used, as a sentence; None where it may.
    """
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=_PRIVATE, exist_ok=True)
    except OSError as error:
        return f"{error.filename}: {error.strerror}; set {CACHE_VARIABLE} to another folder."
    return _problem_of(folder, CACHE_VARIABLE)


def _problem_of(folder: pathlib.Path, variable: str) -> str | None:
    """Why a folder that is there must not be used, where an environment variable names another."""
    try:
        status = folder.stat()
    except OSError as error:
        return f"{error.filename}: {error.strerror}; set {variable} to another folder."
    if not hasattr(os, "getuid"):
        return None  # a system without owners and modes of files
    # Root can do as it likes anyway.
    if status.st_uid not in (os.getuid(), _ROOT):
        return f"{folder} belongs to another user, who could run code as you; set {variable}."
    if status.st_mode & _OTHERS_WRITE:
        return f"Others may write to {folder} and so run code as you; empty it, then run chmod 700 on it."
    return None


def _problem_of_jaxs() -> str | None:
    """Why the folder that the user has given to JAX must not be used; JAX makes one that is missing."""
    folder = jax.config.values["jax_compilation_cache_dir"]
    if folder is None or folder in _chosen_here or "://" in folder or not pathlib.Path(folder).exists():
        return None
    return _problem_of(pathlib.Path(folder), "JAX_COMPILATION_CACHE_DIR")


def _move_jaxs(folder: str | None) -> None:
    """Sets JAX's folder, which JAX reads at its first compilation, and remembers."""
    jax.config.update("jax_compilation_cache_dir", folder)
    compilation_cache.reset_cache()


def keep_compiled(folder: pathlib.Path) -> None:
    """Switches JAX's compilation cache on, with checksums, unless the user has set it up already.

    Args:
      folder: where it is to be.
    """
    if jax.config.values["jax_compilation_cache_dir"] in (None, *_chosen_here):
        _chosen_here.add(str(folder))
        check_entries(_chosen_here)
        _move_jaxs(str(folder))


@dataclasses.dataclass(frozen=True)
class CacheFolders:
    """The caches of a process, for those that it starts."""

    compiled: str | None
    """Of JAX's compilation cache; None where it is off."""
    is_enabled: bool
    """Whether `enable_cache` was called."""
    programs: str | None
    """Of traced programs; None where none are kept."""
    is_checked: bool
    """Whether JAX's cache is jaxbox's, and its entries have checksums."""

    @classmethod
    def of_this_process(cls) -> "CacheFolders":
        """As they are now."""
        programs = compiled.kept_programs()
        folder = programs.folder if isinstance(programs, KeptPrograms) else None
        of_jax = jax.config.values["jax_compilation_cache_dir"]
        return cls(
            compiled=of_jax,
            is_checked=of_jax in _chosen_here,
            is_enabled=programs is not None,
            programs=None if folder is None else str(folder),
        )

    def apply(self) -> None:
        """Makes them those of this process, before anything is compiled in it."""
        if self.compiled is not None and self.is_checked:
            _chosen_here.add(self.compiled)
            check_entries(_chosen_here)
        _move_jaxs(self.compiled)
        if self.is_enabled:
            folder = None if self.programs is None else pathlib.Path(self.programs)
            is_refused = folder is None or make_private(folder) is not None
            compiled.use_programs(KeptPrograms(None if is_refused else folder))
