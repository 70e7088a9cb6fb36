"""Moved to `playground.errors`."""

from playground.errors import lookup as lookup
