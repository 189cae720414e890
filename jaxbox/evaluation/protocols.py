"""Named sets of frames that published figures are of."""

import enum
import functools
import importlib.resources


class Protocol(enum.StrEnum):
    """Sets of frames that people compare on."""

    KITTI_VAL = "kitti-val"
    """The 3,769 validation frames of KITTI's 7,481 labelled ones, as Chen et al. (3DOP, NeurIPS 2015) split
    them; OpenPCDet and MMDetection3D list the same."""


_FILES = {Protocol.KITTI_VAL: "kitti_val.txt"}


@functools.cache
def protocol_frames(protocol: Protocol) -> tuple[str, ...]:
    """The frames of a protocol.

    Args:
      protocol: which.

    Returns:
      Their names, in order.

    >>> frames = protocol_frames(Protocol.KITTI_VAL)
    >>> len(frames), frames[0], frames[-1]
    (3769, '000001', '007480')
    """
    file = importlib.resources.files("jaxbox.evaluation").joinpath(_FILES[protocol])
    return tuple(file.read_text(encoding="ascii").split())
