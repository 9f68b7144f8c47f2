"""What the studies share: runs become rows, rows become findings, findings fill templates."""
