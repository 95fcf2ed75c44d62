"""Networks and settings of a trained filter for programs without torch."""
