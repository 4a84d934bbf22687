"""Which pixels of every view show the object."""
