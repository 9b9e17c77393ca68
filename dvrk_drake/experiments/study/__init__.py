"""Many simulations: poses, seeds and parameter errors on all cores or a cluster."""
