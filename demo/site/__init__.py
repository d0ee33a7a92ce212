"""What is photographed: the house and its surroundings as textured faces."""
