"""Provider of the algorithms, and the option of Processing that names the program."""

from __future__ import annotations

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsApplication, QgsProcessingProvider

from .algorithms import ALGORITHMS
from .program import SETTING


class GeorefProvider(QgsProcessingProvider):
    """Algorithms that call `georef`."""

    def id(self) -> str:
        return "georef"

    def name(self) -> str:
        return "GeoRefGS"

    def load(self) -> bool:
        ProcessingConfig.settingIcons[self.name()] = self.icon()
        text = "Program georef (empty: the variable GEOREF, else that on PATH)"
        ProcessingConfig.addSetting(Setting(self.name(), SETTING, text, "", valuetype=Setting.FILE))
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self) -> None:
        ProcessingConfig.removeSetting(SETTING)

    def loadAlgorithms(self) -> None:
        for algorithm in ALGORITHMS:
            self.addAlgorithm(algorithm())


class GeorefPlugin:
    """Plugin that registers the provider while it is enabled."""

    def __init__(self) -> None:
        self._provider = GeorefProvider()

    def initProcessing(self) -> None:
        """Register the provider; all that qgis_process calls."""
        QgsApplication.processingRegistry().addProvider(self._provider)

    def initGui(self) -> None:
        """Register the provider in QGIS with windows."""
        self.initProcessing()

    def unload(self) -> None:
        """Remove the provider."""
        QgsApplication.processingRegistry().removeProvider(self._provider)
