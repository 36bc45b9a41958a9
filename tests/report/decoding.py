"""The data of a page, read back by other means than the page's own scripts."""

import base64
import gzip
import json
from html.parser import HTMLParser

import numpy as np

TYPES = {"f8": np.float64, "u4": np.uint32, "u2": np.uint16, "u1": np.uint8, "i2": np.int16}


class Page(HTMLParser):
    """The elements of a page, and the texts in its scripts and styles."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.raw, self.words = [], [], []
        self._open = None
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self._open = [tag, dict(attrs), ""]
            self.raw.append(self._open)

    def handle_endtag(self, tag):
        if tag in ("script", "style"):
            self._open = None

    def handle_data(self, data):
        if self._open is not None:
            self._open[2] += data
        else:
            self.words.append(data)

    @property
    def shown(self):
        """All text outside of scripts and styles, with single blanks."""
        return " ".join(" ".join(self.words).split())

    def script(self, identity):
        return next(text for _, attrs, text in self.raw if attrs.get("id") == identity)

    @property
    def data(self):
        return json.loads(self.script("page-data"))

    def column(self, described):
        """Return a column: its bytes lie in planes, all first bytes before all second ones."""
        sizes = self.data["sizes"]
        whole = gzip.decompress(base64.b64decode(self.script("page-columns")))
        start = sum(sizes[: described["part"]])
        part = whole[start : start + sizes[described["part"]]]
        kind = np.dtype(TYPES[described["type"]])
        planes = np.frombuffer(part, np.uint8).reshape(kind.itemsize, -1)
        return np.frombuffer(planes.T.tobytes(), kind).reshape(described["shape"])
