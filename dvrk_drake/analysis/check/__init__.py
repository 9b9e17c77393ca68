"""What is wrong with a recording, before anything is identified from it."""
