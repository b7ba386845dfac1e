"""Live flight in real time: processes for control, learning and the plant, and the bus between them."""
