"""Many runs of one scenario: moments, blocks of replicas, worker processes, the ensemble."""
