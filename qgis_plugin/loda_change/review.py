"""Going through the changes one by one: the next that nobody has looked at, its form and its picture."""

from __future__ import annotations

from qgis.core import QgsFeatureRequest, QgsVectorLayer
from qgis.PyQt.QtCore import Qt
from qgis.PyQt.QtGui import QPixmap
from qgis.PyQt.QtWidgets import QDialog, QLabel, QScrollArea, QVBoxLayout

from .pictures import picture
from .results import folder_of

COLUMNS = {"object_id", "label", "reason", "review_status", "review_note"}
UNREVIEWED = '"review_status" IS NULL OR "review_status" = \'unreviewed\''
ROOM = 1.6
"""The map shows so many times the extent of a change, and ..."""
LEAST_M = 25.0
"""... no less than this."""


def is_changes_layer(layer):
    """Whether this is the layer of changes of some run."""
    return isinstance(layer, QgsVectorLayer) and set(layer.fields().names()) >= COLUMNS


def next_unreviewed(layer, after=None):
    """The first change without a review behind object ``after``, from the beginning again at the end; or None."""
    waiting = sorted(
        layer.getFeatures(QgsFeatureRequest().setFilterExpression(UNREVIEWED)), key=lambda f: f["object_id"]
    )
    behind = [feature for feature in waiting if after is None or feature["object_id"] > after]
    return next(iter(behind or waiting), None)


def n_unreviewed(layer):
    """How many changes nobody has looked at."""
    return sum(1 for _ in layer.getFeatures(QgsFeatureRequest().setFilterExpression(UNREVIEWED)))


def zoom_to(canvas, layer, feature):
    """Show a change with some room around it, and select it."""
    layer.selectByIds([feature.id()])
    box = canvas.mapSettings().layerExtentToOutputExtent(layer, feature.geometry().boundingBox())
    metre = 1.0 if not canvas.mapSettings().destinationCrs().isGeographic() else 1.0 / 111_320.0
    side = max(box.width(), box.height(), LEAST_M * metre / ROOM)
    box.grow((side - min(box.width(), box.height())) / 2)
    box.scale(ROOM)
    canvas.setExtent(box)
    canvas.refresh()


def review(iface, layer, feature):
    """Open the form of a change and save what was noted; True where something was."""
    was_editable = layer.isEditable()
    if not was_editable and not layer.startEditing():
        iface.messageBar().pushWarning("LoDA", f"{layer.name()} cannot be edited: is its file write-protected?")
        return False
    accepted = iface.openFeatureForm(layer, feature, False, True)
    if was_editable:
        return accepted
    if accepted and layer.isModified():
        if layer.commitChanges():
            return True
        iface.messageBar().pushWarning("LoDA", f"Not saved: {'; '.join(layer.commitErrors())}")
        return False
    layer.rollBack()
    return False


def title(feature):
    """What a change is called, e.g. ``Added building 12``."""
    return f"{feature['label']} {feature['object_class']} {feature['object_id']}"


def chosen(layer):
    """The one selected change, or None."""
    features = list(layer.getSelectedFeatures())
    return features[0] if len(features) == 1 else None


class PictureDialog(QDialog):
    """Before and after of one change; stays open beside the map and shows the next one too."""

    def __init__(self, parent=None):
        super().__init__(parent)
        self.setWindowFlag(Qt.WindowType.Tool)
        self._words = QLabel()
        self._words.setWordWrap(True)
        self._picture = QLabel()
        scrolled = QScrollArea()
        scrolled.setWidget(self._picture)
        scrolled.setWidgetResizable(True)
        layout = QVBoxLayout(self)
        layout.addWidget(self._words)
        layout.addWidget(scrolled, 1)
        self.resize(900, 640)

    def show_change(self, layer, feature):
        """Show the picture of a change, or say that there is none."""
        self.setWindowTitle(title(feature))
        self._words.setText(str(feature["reason"] or ""))
        image = picture(folder_of(layer), feature["object_id"])
        if image is None:
            self._picture.setText(
                "The report pictures the largest and most certain changes; this one is not among them."
            )
        else:
            self._picture.setPixmap(QPixmap.fromImage(image))
        self.show()
        self.raise_()
