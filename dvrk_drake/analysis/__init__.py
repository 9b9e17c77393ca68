"""What is learnt offline from recordings."""
