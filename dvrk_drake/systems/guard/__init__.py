"""Command guard between the senders of commands and the motors of an arm. Independent of Drake and LCM."""
