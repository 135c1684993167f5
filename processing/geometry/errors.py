"""Errors of the relation between an image and its geometry."""

from processing.errors import NotDetermined, ProcessError


class GeometryError(ProcessError):
    """The geometry asked for cannot be had; the message says why and what to do."""


class OutlineNotFound(NotDetermined):
    """The image does not show the outline that was looked for."""
