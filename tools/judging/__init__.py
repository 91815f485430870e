"""What judges estimators, verdicts and films."""
