"""The before and after picture of a change, taken out of the report of its run."""

from __future__ import annotations

import base64
import re
from functools import lru_cache
from pathlib import Path

from qgis.PyQt.QtCore import QBuffer, QByteArray, QIODevice, QRectF, Qt
from qgis.PyQt.QtGui import QColor, QFont, QImage, QPainter
from qgis.PyQt.QtSvg import QSvgRenderer

WIDTH = 420
"""Width of one of the pictures, pixels; before and after stand side by side."""
_GAP, _HEAD = 8, 22

_SVG = re.compile(r'<svg viewBox="0 0 (\d+) (\d+)".*?</svg>', re.DOTALL)
_HALO = re.compile(r' stroke="#fff" stroke-width="3" paint-order="stroke"')


def picture(folder, object_id):
    """The picture of an object as QImage, or None where the report has none of it."""
    svgs = _svgs(Path(folder) / "report.html", f"c{int(object_id)}")
    return _painted(svgs) if svgs else None


def picture_tag(folder, object_id):
    """The picture as an HTML image that holds its own data; empty where there is none."""
    image = picture(folder, object_id)
    if image is None:
        return ""
    held = QByteArray()
    buffer = QBuffer(held)
    buffer.open(QIODevice.OpenModeFlag.WriteOnly)
    image.save(buffer, "PNG")
    data = base64.b64encode(bytes(held)).decode("ascii")
    return f'<img width="430" src="data:image/png;base64,{data}">'


def _svgs(report, anchor):
    """SVG documents of a card of the report."""
    try:
        text = _page(str(report), report.stat().st_mtime_ns)
    except OSError:
        return []
    begin = text.find(f'<article class="card" id="{anchor}"')
    if begin < 0:
        return []
    card = text[begin : text.find("</article>", begin)]
    return [(int(m[1]), int(m[2]), _standalone(m[0])) for m in _SVG.finditer(card)]


@lru_cache(maxsize=2)
def _page(path, changed_at):
    return Path(path).read_text(encoding="utf-8")


def _standalone(svg):
    """The drawing as a document of its own, in the words that Qt's SVG knows."""
    names = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'
    return _HALO.sub("", svg.replace("<svg ", f"<svg {names} ", 1).replace("<image href=", "<image xlink:href="))


def _painted(svgs):
    """Plan and profile, before on the left and after on the right."""
    rows = [svgs[first : first + 2] for first in range(0, len(svgs), 2)]
    heights = [round(row[0][1] * WIDTH / row[0][0]) for row in rows]
    image = QImage(2 * WIDTH + _GAP, _HEAD + sum(heights) + _GAP * (len(rows) - 1), QImage.Format.Format_RGB32)
    image.fill(QColor("white"))
    painter = QPainter(image)
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    font = QFont()
    font.setPixelSize(14)
    font.setBold(True)
    painter.setFont(font)
    for column, title in enumerate(("Before", "After")):
        place = QRectF(column * (WIDTH + _GAP), 0, WIDTH, _HEAD)
        painter.drawText(place, Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter, title)
    top = _HEAD
    for row, height in zip(rows, heights):
        for column, (_, _, svg) in enumerate(row):
            place = QRectF(column * (WIDTH + _GAP), top, WIDTH, height)
            QSvgRenderer(QByteArray(svg.encode("utf-8"))).render(painter, place)
        top += height + _GAP
    painter.end()
    return image
