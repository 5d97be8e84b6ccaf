"""The same corners through other tools."""
