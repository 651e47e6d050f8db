"""Contacts of CAD objects with the hull: where, how near, how deep, how sure."""
