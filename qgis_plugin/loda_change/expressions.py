"""The expression function ``loda_picture``, for map tips and print layouts."""

from __future__ import annotations

from qgis.core import QgsExpression, QgsExpressionFunction, QgsProject

from .pictures import picture_tag
from .results import folder_of

NAME = "loda_picture"


class PictureFunction(QgsExpressionFunction):
    """``loda_picture(layer, object_id)``: an HTML image."""

    def __init__(self):
        super().__init__(NAME, 2, "LoDA", "The before and after picture of a change as an HTML image.")

    def func(self, values, context, parent, node):
        layer = QgsProject.instance().mapLayer(str(values[0]))
        return picture_tag(folder_of(layer), values[1]) if layer is not None and values[1] is not None else ""

    def usesGeometry(self, node):
        return False

    def referencedColumns(self, node):
        return []

    def clone(self):
        return PictureFunction()


_FUNCTION = PictureFunction()


def register():
    """Make the function known to QGIS."""
    QgsExpression.registerFunction(_FUNCTION)


def unregister():
    """Take it away again."""
    QgsExpression.unregisterFunction(NAME)
