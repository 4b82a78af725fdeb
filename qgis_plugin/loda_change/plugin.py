"""The plugin: its provider in Processing, its options page, and the toolbar for the review."""

from __future__ import annotations

from pathlib import Path

from qgis.core import QgsApplication, QgsProject
from qgis.PyQt.QtCore import QUrl
from qgis.PyQt.QtGui import QAction, QDesktopServices, QIcon

from . import expressions, review
from .options import TITLE, OptionsFactory
from .provider import LodaProvider
from .results import folder_of

ICONS = Path(__file__).resolve().parent / "icons"


class LodaChangePlugin:
    """What QGIS loads; in `qgis_process` there is no ``iface`` and only the provider is made."""

    def __init__(self, iface):
        self.iface = iface
        self.provider = None
        self._actions = []
        self._options = self._toolbar = self._pictures = None
        self._last = {}

    def initProcessing(self):
        self.provider = LodaProvider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self):
        self.initProcessing()
        expressions.register()
        self._options = OptionsFactory()
        self.iface.registerOptionsWidgetFactory(self._options)
        self._toolbar = self.iface.addToolBar(TITLE)
        self._toolbar.setObjectName("LodaChangeToolbar")
        for icon, text, tip, slot in (
            ("detect", "Detect changes…", "Find what changed between two surveys", self.open_detect),
            ("next", "Next unreviewed change", "Zoom to the next change and review it", self.review_next),
            ("picture", "Picture of the change", "Before and after of the selected change", self.show_picture),
            ("report", "Open the report", "The report of the result in the browser", self.open_report),
        ):
            action = QAction(QIcon(str(ICONS / f"{icon}.svg")), text, self.iface.mainWindow())
            action.setToolTip(tip)
            action.triggered.connect(slot)
            self._toolbar.addAction(action)
            self.iface.addPluginToMenu(TITLE, action)
            self._actions.append(action)

    def unload(self):
        if self.provider is not None:
            QgsApplication.processingRegistry().removeProvider(self.provider)
            self.provider = None
        if self._options is None:
            return
        self.iface.unregisterOptionsWidgetFactory(self._options)
        for action in self._actions:
            self.iface.removePluginMenu(TITLE, action)
        self._toolbar.deleteLater()
        if self._pictures is not None:
            self._pictures.deleteLater()
        expressions.unregister()

    def open_detect(self):
        """The dialog of Detect changes."""
        import processing

        processing.execAlgorithmDialog("loda:detectchanges")

    def review_next(self):
        """Zoom to the next change that nobody has looked at, show its picture and open its form."""
        layer = self._changes()
        if layer is None:
            return
        feature = review.next_unreviewed(layer, self._last.get(layer.id()))
        if feature is None:
            self.iface.messageBar().pushSuccess("LoDA", f"All changes of {layer.name()} are reviewed.")
            return
        self._last[layer.id()] = feature["object_id"]
        review.zoom_to(self.iface.mapCanvas(), layer, feature)
        self._show(layer, feature)
        review.review(self.iface, layer, feature)
        left = review.n_unreviewed(layer)
        self.iface.messageBar().pushInfo("LoDA", f"{left} changes of {layer.name()} are still unreviewed.")

    def show_picture(self):
        """Before and after of the selected change."""
        layer = self._changes()
        if layer is None:
            return
        feature = review.chosen(layer) or review.next_unreviewed(layer)
        if feature is not None:
            self._show(layer, feature)

    def open_report(self):
        """The report of the result that the layer belongs to."""
        layer = self._changes()
        if layer is not None:
            QDesktopServices.openUrl(QUrl.fromLocalFile(str(folder_of(layer) / "report.html")))

    def _show(self, layer, feature):
        if self._pictures is None:
            self._pictures = review.PictureDialog(self.iface.mainWindow())
        self._pictures.show_change(layer, feature)

    def _changes(self):
        """The layer of changes that is meant: the active one, else the first in the project."""
        layers = [self.iface.activeLayer(), *QgsProject.instance().mapLayers().values()]
        found = next((layer for layer in layers if review.is_changes_layer(layer)), None)
        if found is None:
            self.iface.messageBar().pushInfo(
                "LoDA", "There is no layer of changes yet: run Detect changes, or load one."
            )
        return found
