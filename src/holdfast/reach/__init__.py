"""What a stealthy attacker can reach, and policies of authentication that bound it."""
