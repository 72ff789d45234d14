"""What each camera did to the light: formation, adjustment, and the choice between models."""
