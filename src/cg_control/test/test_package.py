"""The package that was built is the one described in package.xml."""

import xml.etree.ElementTree as ElementTree
from importlib.metadata import version
from pathlib import Path


def test_built_version_is_the_one_of_package_xml():
    manifest = ElementTree.parse(Path(__file__).parents[1] / 'package.xml')
    assert version('cg_control') == manifest.findtext('version')
