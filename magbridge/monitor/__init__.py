"""The ground station's page: what a person who watches a vehicle wants to see of its bridge."""
