"""What a running firmware shows to other processes, and what it hears from them; the loop waits for neither."""
