"""Controllers: the plug-ins that offer them, the graph that they form, the manager that updates them."""
