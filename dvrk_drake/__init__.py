"""Model, identify, compensate and simulate da Vinci Research Kit arms with Drake."""
