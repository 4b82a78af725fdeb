"""The engine, `loda-pdal`, seen from QGIS: found, installed and run as a process of its own. No qgis in here."""
