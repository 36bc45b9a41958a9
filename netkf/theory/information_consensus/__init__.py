"""Theory of consensus on information (HCMCI, CM, CI, ICF): assumptions and exact errors."""
