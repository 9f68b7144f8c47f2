"""What steps share beside their formulas: prediction, switching, defects."""
