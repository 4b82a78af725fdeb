"""Object-level change detection between two LiDAR surveys, in QGIS; the engine is the command ``loda-pdal``."""


def classFactory(iface):
    """The plugin object that QGIS asks for."""
    from .plugin import LodaChangePlugin

    return LodaChangePlugin(iface)
