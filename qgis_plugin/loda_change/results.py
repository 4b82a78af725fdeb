"""Results on the map: which layers of a folder are loaded, what they are called and how they look."""

from __future__ import annotations

import html
from pathlib import Path

from qgis.core import (
    QgsColorRampShader,
    QgsPointCloudCategory,
    QgsPointCloudClassifiedRenderer,
    QgsProcessingContext,
    QgsProcessingLayerPostProcessorInterface,
    QgsProcessingUtils,
    QgsProject,
    QgsProviderRegistry,
    QgsRasterShader,
    QgsSingleBandPseudoColorRenderer,
    QgsVectorLayer,
)
from qgis.PyQt import sip
from qgis.PyQt.QtGui import QColor

from .legend import CHANGE_CLASSES, FAINT, LOD_CLASSES, NO_CHANGE

PICTURE_IN_TIP = "[% coalesce(loda_picture(@layer_id, \"object_id\"), '') %]"
"""Added to the map tip that the GeoPackage brings: the before and after picture, where the report has one."""

_LAYERS = (
    ("changes.gpkg|layername=changes", "Changes", 40),
    ("changes.gpkg|layername=ground_changes", "Ground changes", 30),
    ("changes.copc.laz", "Points by change", 20),
    ("registered.copc.laz", "Registered points", 20),
    ("lod95.copc.laz", "Points with LoD95", 20),
    ("segmented.copc.laz", "Segmented points", 20),
    ("lod95.tif", "Limit of detection (LoD95)", 10),
)
"""Source in the folder, name, and place from bottom to top."""


class _Styler(QgsProcessingLayerPostProcessorInterface):
    """Finishes a layer once it is on the map, and takes away the one of the result before."""

    def postProcessLayer(self, layer, context, feedback):
        project = context.project() or QgsProject.instance()
        same = [other.id() for other in project.mapLayers().values() if other.source() == layer.source()]
        project.removeMapLayers([number for number in same if number != layer.id()])
        style(layer)


_stylers = []


def _new_styler():
    """A styler for one layer: the context deletes it in the end, and Python must not do so before."""
    _stylers[:] = [styler for styler in _stylers if not sip.isdeleted(styler)]
    _stylers.append(_Styler())
    return _stylers[-1]


def load_later(folder, context):
    """Have the layers of a result folder added to the map when the algorithm is over."""
    folder = Path(folder)
    for source, name, place in _LAYERS:
        if not (folder / source.partition("|")[0]).exists():
            continue
        uri = str(folder / source)
        if not can_open(uri):
            continue
        details = QgsProcessingContext.LayerDetails(name, context.project(), name, _hint(source))
        details.groupName = f"LoDA: {folder.name}"
        details.layerSortKey = place
        details.forceName = True  # not the name of the file
        details.setPostProcessor(_new_styler())
        context.addLayerToLoadOnCompletion(uri, details)


def can_open(uri):
    """Whether this QGIS opens the file: plain LAZ needs its PDAL provider, which not every QGIS has."""
    if uri.endswith(".laz") and not uri.endswith(".copc.laz"):
        return "pdal" in QgsProviderRegistry.instance().providerList()
    return True


def _hint(source):
    hints = QgsProcessingUtils.LayerHint
    if "|" in source:
        return hints.Vector
    return hints.Raster if source.endswith(".tif") else hints.PointCloud


def style(layer):
    """Colours, legend and map tip of a layer of ours."""
    source = Path(layer.source().partition("|")[0]).name
    if isinstance(layer, QgsVectorLayer):
        layer.loadDefaultStyle()  # from the GeoPackage; Processing loads layers without
        if layer.source().endswith("layername=changes") and PICTURE_IN_TIP not in layer.mapTipTemplate():
            layer.setMapTipTemplate(layer.mapTipTemplate() + PICTURE_IN_TIP)
    elif source == "lod95.tif":
        _style_lod(layer)
    elif source == "changes.copc.laz":
        _style_cloud(layer)
    layer.triggerRepaint()


def _style_lod(layer):
    items = []
    below = 0.0
    for upper, colour in LOD_CLASSES:
        words = f"{below:.2f} to {upper:.2f} m" if upper < float("inf") else f"above {below:.2f} m"
        items.append(QgsColorRampShader.ColorRampItem(upper, QColor(colour), words))
        below = upper
    ramp = QgsColorRampShader()
    ramp.setColorRampType(QgsColorRampShader.Type.Discrete)
    ramp.setColorRampItemList(items)
    shader = QgsRasterShader()
    shader.setRasterShaderFunction(ramp)
    renderer = QgsSingleBandPseudoColorRenderer(layer.dataProvider(), 1, shader)
    renderer.setOpacity(0.7)
    layer.setRenderer(renderer)


def _style_cloud(layer):
    categories = []
    for code, title, colour in CHANGE_CLASSES:
        shown = QColor(colour)
        shown.setAlpha(FAINT if code in NO_CHANGE else 255)
        categories.append(QgsPointCloudCategory(code, shown, title))
    renderer = QgsPointCloudClassifiedRenderer("ChangeClass", categories)
    renderer.setPointSize(0.6)
    layer.setRenderer(renderer)


def folder_of(layer):
    """The result folder that a layer of ours lies in."""
    return Path(layer.source().partition("|")[0]).parent


def unsaved_layers(folder, project=None):
    """Titles of the layers of this folder with edits that are not saved."""
    folder = Path(folder).absolute()
    return [
        html.unescape(layer.name())
        for layer in (project or QgsProject.instance()).mapLayers().values()
        if isinstance(layer, QgsVectorLayer) and layer.isModified() and folder_of(layer).absolute() == folder
    ]
