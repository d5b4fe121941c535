"""The version of the library: one constant that packaging, file metadata and the command line read."""

__version__ = "0.1.0"
