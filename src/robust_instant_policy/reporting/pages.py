"""HTML pages from the templates beside this file. Every value is escaped unless it is `Markup`."""

import base64
import re
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from numpy.typing import NDArray
from PIL import Image

from robust_instant_policy.datasets.images import encode_image

JPEG_QUALITY = 88
PNG_COLOURS = 256


def render(template: str, **values: Any) -> str:
    """The page of ``templates/template``. It needs no other file and no network."""
    return _ENVIRONMENT.get_template(template).render(values)


def data_uri(content: bytes, kind: str) -> str:
    """``content`` of the media type ``kind`` as a URL that holds it."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def jpeg(image: NDArray[np.uint8]) -> str:
    """Data URL of a photograph ``(H, W, 3)``."""
    return data_uri(encode_image(image, "jpeg", quality=JPEG_QUALITY), "image/jpeg")


def png(image: NDArray[np.uint8]) -> str:
    """Data URL of a drawing ``(H, W, 3)`` with few colours."""
    few = Image.fromarray(image).quantize(PNG_COLOURS)
    return data_uri(encode_image(few, "png", optimize=True), "image/png")


def inline(text: str) -> Markup:
    """``text`` with ``**bold**`` and ```code``` as HTML, as in the cells of a `Table`."""
    bold = re.sub(r"\*\*(\S.*?)\*\*", r"<b>\1</b>", str(escape(text))).replace("\\*", "*")
    return Markup(re.sub(r"`(.+?)`", r"<code>\1</code>", bold))


_ENVIRONMENT = Environment(
    loader=PackageLoader(__package__), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
)
_ENVIRONMENT.filters["inline"] = inline
