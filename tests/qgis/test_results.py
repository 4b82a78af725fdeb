"""What the user sees of a result: layers, colours, labels, map tips, pictures, and reviews that last."""

from __future__ import annotations

import gc
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from qgis.core import (
    QgsExpression,
    QgsExpressionContext,
    QgsExpressionContextUtils,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsPointCloudLayer,
    QgsProcessingUtils,
    QgsRasterLayer,
    QgsRectangle,
    QgsVectorLayer,
)
from qgis.gui import QgsMapCanvas
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor

from conftest import Listening

COLOURS = {"Added": "#0072b2", "Removed": "#d55e00", "Increased": "#56b4e9", "Decreased": "#e69f00"}


@pytest.fixture
def folder(detected, tmp_path):
    """A copy of the shared result, to change at will."""
    return Path(shutil.copytree(detected["OUTPUT"], tmp_path / "street"))


@pytest.fixture
def changes(folder, project):
    """The layer of changes, styled as the plugin styles it, in the project."""
    from loda_change import results

    layer = QgsVectorLayer(f"{folder / 'changes.gpkg'}|layername=changes", "Changes")
    results.style(layer)
    project.addMapLayer(layer)
    return layer


def rendered(layers, extent, size=600):
    """The layers drawn on white."""
    settings = QgsMapSettings()
    settings.setLayers(layers)
    settings.setDestinationCrs(layers[0].crs())
    settings.setExtent(extent)
    settings.setOutputSize(QSize(size, size))
    settings.setBackgroundColor(QColor("white"))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    return job.renderedImage()


def pixels(image):
    """How often each colour occurs."""
    counts = {}
    for y in range(image.height()):
        for x in range(image.width()):
            colour = image.pixel(x, y) & 0xFFFFFF
            counts[colour] = counts.get(colour, 0) + 1
    return counts


def number(colour, opacity=1.0):
    """A colour laid over white."""
    mixed = (round(opacity * c + (1 - opacity) * 255) for c in QColor(colour).getRgb()[:3])
    return tuple(mixed)


def nearest(counts, wanted, tolerance=6):
    """How many pixels have about this colour."""
    rgb = [((c >> 16 & 255, c >> 8 & 255, c & 255), n) for c, n in counts.items()]
    return sum(n for colour, n in rgb if all(abs(a - b) <= tolerance for a, b in zip(colour, wanted, strict=True)))


@pytest.mark.parametrize("label", list(COLOURS))
def test_changes_are_drawn_in_the_colour_of_their_label_and_fainter_where_less_sure(changes, label):
    changes.setLabelsEnabled(False)
    feature = max((f for f in changes.getFeatures() if f["label"] == label), key=lambda f: f.geometry().area())
    point = feature.geometry().pointOnSurface().asPoint()
    image = rendered([changes], QgsRectangle(point.x() - 0.2, point.y() - 0.2, point.x() + 0.2, point.y() + 0.2), 40)
    opacity = 170 / 255 * (0.45 + 0.55 * feature["confidence"])
    got = QColor(image.pixel(20, 20)).getRgb()[:3]
    assert all(abs(a - b) <= 3 for a, b in zip(got, number(COLOURS[label], opacity), strict=True)), (got, opacity)


def test_labels_appear_on_zoom(changes):
    feature = max((f for f in changes.getFeatures() if f["label"] == "Added"), key=lambda f: f.geometry().area())
    box = feature.geometry().boundingBox()
    box.grow(15)
    with_labels = pixels(rendered([changes], box))
    changes.setLabelsEnabled(False)
    without = pixels(rendered([changes], box))
    dark = number("#141414")
    assert nearest(with_labels, dark, 40) > nearest(without, dark, 40) + 50
    assert changes.labeling().settings().scaleVisibility and changes.labeling().settings().minimumScale == 1500


def test_the_map_tip_tells_the_reason_and_shows_before_and_after(changes):
    feature = next(f for f in changes.getFeatures() if f["label"] == "Added")
    context = QgsExpressionContext(QgsExpressionContextUtils.globalProjectLayerScopes(changes))
    context.setFeature(feature)
    tip = QgsExpression.replaceExpressionText(changes.mapTipTemplate(), context)
    assert feature["reason"] in tip and "<img" in tip and "data:image/png;base64," in tip


def test_the_picture_is_that_of_the_report(changes, folder):
    from loda_change.pictures import picture

    feature = next(f for f in changes.getFeatures() if f["label"] == "Added")
    image = picture(folder, feature["object_id"])
    counts = pixels(image.scaledToWidth(300))
    assert image.width() > 800 and image.height() > 400 and len(counts) > 100
    assert picture(folder, 999_999) is None and picture(folder / "nowhere", 1) is None


def test_all_layers_load_named_grouped_and_styled(run, surveys, folder, project, monkeypatch):
    """The whole way: a run under the variables that QGIS sets, progress, and layers for the map; reviews survive it."""
    changes = QgsVectorLayer(f"{folder / 'changes.gpkg'}|layername=changes", "old")
    first = min(changes.getFeatures(), key=lambda f: f["object_id"])
    changes.startEditing()
    fields = changes.fields()
    changes.changeAttributeValue(first.id(), fields.indexOf("review_status"), "confirmed")
    changes.changeAttributeValue(first.id(), fields.indexOf("review_note"), "Seen on site.")
    assert changes.commitChanges()
    project.addMapLayer(changes)

    for variable in ("PROJ_LIB", "PROJ_DATA", "GDAL_DATA", "GDAL_DRIVER_PATH", "PYTHONPATH", "LD_LIBRARY_PATH"):
        monkeypatch.setenv(variable, "/nowhere")
    feedback = Listening()
    inputs = {"BEFORE": surveys / "before.laz", "AFTER": surveys / "after.laz", "OUTPUT": folder}
    found, context = run("detectchanges", {**inputs, "OVERWRITE": True}, feedback)

    assert feedback.percentages == sorted(feedback.percentages) and len(set(feedback.percentages)) > 10
    assert feedback.percentages[-1] == 100.0
    assert "Registering the epochs" in feedback.stages and "Deciding changes" in feedback.stages
    assert any("measured densely enough" in text for text in feedback.warnings)

    waiting = context.layersToLoadOnCompletion()
    assert {details.name for details in waiting.values()} == {
        "Changes",
        "Ground changes",
        "Points by change",
        "Limit of detection (LoD95)",
    }
    gc.collect()  # the stylers must outlive the algorithm
    layers = {}
    for uri, details in waiting.items():
        layer = QgsProcessingUtils.mapLayerFromString(uri, context, True, details.layerTypeHint)
        assert layer is not None and layer.isValid(), uri
        assert details.groupName == "LoDA: street" and details.forceName
        project.addMapLayer(context.takeResultLayer(layer.id()))
        details.postProcessor().postProcessLayer(layer, context, feedback)
        layers[details.name] = layer
    assert len(project.mapLayers()) == 4  # the layer of the earlier result has gone
    again = {f["object_id"]: f for f in layers["Changes"].getFeatures()}[first["object_id"]]
    assert (again["review_status"], again["review_note"]) == ("confirmed", "Seen on site.")
    assert again["reviewer"] and again["reviewed_at"].isValid()
    assert "confirmed (" in (folder / "report.html").read_text()
    assert found["CHANGED"] > 5

    assert layers["Changes"].renderer().classAttribute() == "label" and layers["Changes"].labelsEnabled()
    assert layers["Ground changes"].renderer().classAttribute() == "label"
    raster = layers["Limit of detection (LoD95)"]
    assert isinstance(raster, QgsRasterLayer)
    legend = [item.label for item in raster.renderer().shader().rasterShaderFunction().colorRampItemList()]
    assert legend[0] == "0.00 to 0.02 m" and legend[-1] == "above 0.40 m"
    assert len(pixels(rendered([raster], raster.extent(), 200))) > 3
    cloud = layers["Points by change"]
    assert isinstance(cloud, QgsPointCloudLayer) and cloud.renderer().attribute() == "ChangeClass"
    counts = pixels(rendered([cloud], cloud.extent(), 300))
    assert nearest(counts, number(COLOURS["Added"])) > 20 and nearest(counts, number("#9aa0a6", 80 / 255)) > 500


def test_the_form_lets_nothing_be_edited_but_the_review(changes):
    form, fields = changes.editFormConfig(), changes.fields()
    editable = {f.name() for i, f in enumerate(fields) if not form.readOnly(i)}
    assert editable == {"review_status", "review_note"}
    assert changes.editorWidgetSetup(fields.indexOf("dh_m")).config()["Precision"] == 3
    choices = changes.editorWidgetSetup(fields.indexOf("review_status"))
    assert choices.type() == "ValueMap"
    assert [next(iter(c.values())) for c in choices.config()["map"]] == [
        "unreviewed",
        "confirmed",
        "rejected",
        "unsure",
    ]


class Desktop:
    """The part of the QGIS desktop that the review uses; its form is filled in by `answer`."""

    def __init__(self, layer, answer):
        self.layer, self.answer, self.messages = layer, answer, []
        self.canvas = QgsMapCanvas()
        self.canvas.setDestinationCrs(layer.crs())

    def openFeatureForm(self, layer, feature, update_only, modal):
        assert modal and not update_only
        for name, value in self.answer.items():
            layer.changeAttributeValue(feature.id(), layer.fields().indexOf(name), value)
        return bool(self.answer)

    def messageBar(self):
        return self

    def pushWarning(self, title, text):
        self.messages.append(text)

    pushInfo = pushSuccess = pushWarning

    def mapCanvas(self):
        return self.canvas

    def activeLayer(self):
        return self.layer

    def mainWindow(self):
        return None


def test_going_through_the_changes_one_by_one(changes, folder, engine_program):
    from loda_change.plugin import LodaChangePlugin

    n = changes.featureCount()
    desktop = Desktop(changes, {"review_status": "rejected", "review_note": "A parked truck."})
    plugin = LodaChangePlugin(desktop)
    ids = sorted(f["object_id"] for f in changes.getFeatures())
    plugin.review_next()
    assert [f["object_id"] for f in changes.selectedFeatures()] == ids[:1]
    assert desktop.messages == [f"{n - 1} changes of Changes are still unreviewed."]
    desktop.answer = {}  # closed without a word: nothing is written, and the next one comes
    plugin.review_next()
    plugin.review_next()
    assert [f["object_id"] for f in changes.selectedFeatures()] == ids[2:3] and not changes.isEditable()
    box = next(changes.getSelectedFeatures()).geometry().boundingBox()
    assert desktop.canvas.extent().contains(box)
    plugin.show_picture()
    assert str(ids[2]) in plugin._pictures.windowTitle()

    fresh = QgsVectorLayer(changes.source(), "again")
    row = next(f for f in fresh.getFeatures() if f["object_id"] == ids[0])
    assert (row["review_status"], row["review_note"]) == ("rejected", "A parked truck.")
    assert row["reviewer"] and row["reviewed_at"].isValid()
    subprocess.run([engine_program, "report", folder], check=True, stdout=subprocess.DEVNULL)
    assert "A parked truck." in (folder / "report.html").read_text()


def test_unsaved_reviews_keep_a_new_run_from_starting(application, changes, folder, surveys):
    changes.startEditing()
    feature = next(changes.getFeatures())
    changes.changeAttributeValue(feature.id(), changes.fields().indexOf("review_note"), "not saved yet")
    detect = application.processingRegistry().createAlgorithmById("loda:detectchanges")
    from qgis.core import QgsProcessingContext

    inputs = {"BEFORE": str(surveys / "before.laz"), "AFTER": str(surveys / "after.laz"), "PRESET": "street"}
    fine, message = detect.checkParameterValues({**inputs, "OUTPUT": str(folder)}, QgsProcessingContext())
    assert not fine and "unsaved" in message
    changes.rollBack()


def test_the_options_page_says_which_engine_is_used(application, engine_program, monkeypatch):
    from loda_change import settings
    from loda_change.options import OptionsPage

    page = OptionsPage()
    assert "loda-pdal 0.1.0, on PATH" in page._state.text()
    page._program.setFilePath("/nowhere/loda-pdal")
    assert "does not exist" in page._state.text()
    page._program.setFilePath(str(engine_program))
    page.apply()
    assert settings.engine() == ([str(engine_program)], "chosen in the settings")
    settings.choose_program("")
    monkeypatch.setenv("PATH", os.devnull)
    page._program.setFilePath("")
    assert "press Install" in page._state.text()
