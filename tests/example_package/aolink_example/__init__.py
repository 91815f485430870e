"""What a package of somebody else adds to aolink: each part is a module of its own."""
