"""Fast checks of photographs and of the machine."""
