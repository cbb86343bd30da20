"""Bus plan: transactions of each cycle, their due times and cost, and the retries at set-up.

Execution of a plan belongs in `exchange`.
"""
