"""Product -> what on the object's surface departs from its own profile, and what of that may be a defect."""
