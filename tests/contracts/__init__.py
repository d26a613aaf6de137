"""What any implementation of the log holds, whatever it rests on."""
