"""What virtual things do when real ones meet them: one file an effect, none imported unasked."""
