"""The version of the package, at the bottom of its layers; ``package.xml`` has the same."""

__version__ = "0.2.0"
