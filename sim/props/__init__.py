"""What worlds are furnished with."""
