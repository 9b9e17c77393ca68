"""What stands between whoever commands an arm and its motors; neither Drake nor LCM is needed for it."""
