"""Traced programs as files: StableHLO with a line that says what it was made of, and a checksum over both."""

import hashlib
import json
import pathlib
import zlib
from collections.abc import Mapping

import jax.export

from jaxbox._files import atomic_path

SUFFIX = ".program"
_MAGIC = b"jaxbox program 1\n"
_DIGEST_SIZE = hashlib.sha256().digest_size


class BrokenProgramError(ValueError):
    """A file that is not a program, or not the one that was written."""


def write_program(path: pathlib.Path, exported: jax.export.Exported, made_of: Mapping[str, str]) -> None:
    """Writes a traced program whole or not at all.

    Args:
      path: of the file.
      exported: the program.
      made_of: what it depends on; `read_program` compares it.

    Raises:
      OSError: where the file cannot be written.
    """
    content = json.dumps(dict(made_of)).encode() + b"\n" + zlib.compress(bytes(exported.serialize()))
    with atomic_path(path) as temporary:
        temporary.write_bytes(_MAGIC + hashlib.sha256(content).digest() + content)


def read_program(path: pathlib.Path, made_of: Mapping[str, str]) -> jax.export.Exported | None:
    """Reads a traced program.

    Args:
      path: of the file.
      made_of: what the program must have been made of.

    Returns:
      The program; None where there is no such file, it is damaged, it was made of something else, or this
      version of JAX does not read it.
    """
    try:
        found, program = _read(path)
        return jax.export.deserialize(bytearray(zlib.decompress(program))) if found == made_of else None
    except Exception:
        # Whatever is wrong with the file, tracing makes another.
        return None


def read_made_of(path: pathlib.Path) -> dict[str, str]:
    """What a program was made of.

    Args:
      path: of the file.

    Returns:
      As `write_program` was given it.

    Raises:
      BrokenProgramError: for a file that is damaged.
      OSError: for a file that cannot be read.
    """
    return _read(path)[0]


def _read(path: pathlib.Path) -> tuple[dict[str, str], bytes]:
    data = path.read_bytes()
    start = len(_MAGIC) + _DIGEST_SIZE
    digest, content = data[len(_MAGIC) : start], data[start:]
    if not data.startswith(_MAGIC) or hashlib.sha256(content).digest() != digest:
        raise BrokenProgramError(f"{path}: not a traced program, or damaged.")
    made_of, _, program = content.partition(b"\n")
    return json.loads(made_of), program
