"""The page in Settings, Options: which engine is used, and a button that installs one."""

from __future__ import annotations

from pathlib import Path

from qgis.core import QgsApplication, QgsTask
from qgis.gui import QgsFileWidget, QgsOptionsPageWidget, QgsOptionsWidgetFactory
from qgis.PyQt.QtCore import pyqtSignal
from qgis.PyQt.QtGui import QIcon
from qgis.PyQt.QtWidgets import QFormLayout, QGroupBox, QHBoxLayout, QLabel, QPlainTextEdit, QPushButton, QVBoxLayout

from . import settings
from .engine.errors import EngineError
from .engine.install import install
from .engine.locate import engine_version, find_engine

ICON = Path(__file__).resolve().parent / "icon.svg"
TITLE = "LoDA Change"


class InstallTask(QgsTask):
    """The installation, beside the desktop: cancelled like every other task."""

    said = pyqtSignal(str)

    def __init__(self, folder, source):
        super().__init__("Installing loda-pdal", QgsTask.Flag.CanCancel)
        self._folder, self._source = folder, source
        self.error = None

    def run(self):
        try:
            install(self._folder, self._source, self.said.emit, self.isCanceled)
        except (EngineError, OSError) as error:
            self.error = error
            return False
        return True

    def finished(self, is_fine):
        self.said.emit("Done." if is_fine else str(self.error or "Stopped."))


class OptionsPage(QgsOptionsPageWidget):
    """Engine found or chosen, its version, and the installation."""

    def __init__(self, parent=None):
        super().__init__(parent)
        self._task = None
        self._state = QLabel()
        self._state.setWordWrap(True)
        self._program = QgsFileWidget()
        self._program.setDialogTitle("The program loda-pdal, or a Python that has it")
        self._program.lineEdit().setPlaceholderText("found by itself")
        self._program.setFilePath(settings.chosen_program())
        self._program.fileChanged.connect(self._check)
        self._source = QgsFileWidget()
        self._source.setDialogTitle("A wheel of loda-pdal, or its folder")
        self._source.lineEdit().setPlaceholderText("loda-pdal from the Python Package Index")
        self._button = QPushButton("Install")
        self._button.clicked.connect(self._install)
        self._log = QPlainTextEdit()
        self._log.setReadOnly(True)
        self._log.setMaximumBlockCount(2000)

        used = QGroupBox("Engine in use")
        form = QFormLayout(used)
        form.addRow("loda-pdal", self._program)
        form.addRow(self._state)
        made = QGroupBox("Install an engine for this profile")
        column = QVBoxLayout(made)
        explanation = QLabel(
            "Makes a Python environment of its own in your profile (about 1 GB) with loda-pdal in it. "
            "QGIS's own Python is not touched. Python 3.11 or later must be on this computer."
        )
        explanation.setWordWrap(True)
        column.addWidget(explanation)
        row = QHBoxLayout()
        row.addWidget(QLabel("From"))
        row.addWidget(self._source, 1)
        row.addWidget(self._button)
        column.addLayout(row)
        column.addWidget(self._log, 1)
        layout = QVBoxLayout(self)
        layout.addWidget(used)
        layout.addWidget(made, 1)
        self._check()

    def apply(self):
        settings.choose_program(self._program.filePath().strip())
        provider = QgsApplication.processingRegistry().providerById("loda")
        if provider is not None:
            provider.refreshAlgorithms()

    def _check(self, *_):
        """Say which engine would be used now."""
        try:
            engine = find_engine(self._program.filePath().strip(), settings.managed_folder())
            version = engine_version(engine, timeout_s=15.0)
            self._state.setText(f"loda-pdal {version}, {engine.origin}:\n{' '.join(engine.command)}")
        except EngineError as error:
            self._state.setText(str(error))

    def _install(self):
        if self._task is not None:
            self._task.cancel()
            return
        self._log.clear()
        self._button.setText("Stop")
        self._task = InstallTask(settings.managed_folder(), self._source.filePath().strip())
        self._task.said.connect(self._log.appendPlainText)
        self._task.taskCompleted.connect(self._installed)
        self._task.taskTerminated.connect(self._installed)
        QgsApplication.taskManager().addTask(self._task)

    def _installed(self):
        self._task = None
        self._button.setText("Install")
        self._check()


class OptionsFactory(QgsOptionsWidgetFactory):
    """Puts the page into the options dialog."""

    def __init__(self):
        super().__init__(TITLE, QIcon(str(ICON)))

    def createWidget(self, parent):
        return OptionsPage(parent)
