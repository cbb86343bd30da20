"""Controllers: their contract, the plug-ins that offer them, and the manager that updates them."""
