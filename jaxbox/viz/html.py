"""What a notebook shows of boxes: their text, and a picture of them."""

import base64
import html

import numpy as np

from jaxbox.viz.canvas import encode_png


def picture_with_text(text: str, picture: np.ndarray) -> str:
    """A piece of a page that needs no other file.

    Args:
      text: lines, also what the picture says to those who cannot see it.
      picture: (h, w, 3) uint8, red green blue.

    Returns:
      HTML.

    Raises:
      ValueError: for a picture of another shape or type.
    """
    words, data = html.escape(text), base64.b64encode(encode_png(picture)).decode()
    return f'<pre>{words}</pre><img alt="{words}" style="max-width: 100%" src="data:image/png;base64,{data}">'
