"""Command guard between the senders of commands and the motors of an arm. It does not depend on Drake."""
