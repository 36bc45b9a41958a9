"""Theory of the push-sum filter (P): limits, certified and exact gamma, mean squares of errors."""
