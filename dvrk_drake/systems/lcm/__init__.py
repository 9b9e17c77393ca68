"""Drake systems for both ends of an arm's LCM channels: the controller and the arm."""
