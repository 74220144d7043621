"""What people call: sessions, several recordings, planning, validation, following, fleets, the command and Python."""
