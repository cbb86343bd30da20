"""Bus plan: computes the transactions of each cycle with due times and cost, and repeats lost requests at
set-up.

Execution of a plan belongs in `exchange`."""
