"""3D views of arms in Meshcat: page and camera, overlay (ghost, efforts, frames, names, captions), and controls."""
