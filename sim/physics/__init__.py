"""What moves the drone: rotors, air, contact, and the controller that steers them."""
