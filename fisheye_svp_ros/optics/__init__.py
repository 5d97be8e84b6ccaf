"""How a point becomes an image point: curves, lens, ray equation, camera and engines."""
